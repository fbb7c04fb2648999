"""Ends the process while threads still compute."""

import logging
import os
import sys
from typing import NoReturn


def end_process(status: int) -> NoReturn:
    """End the process at once, after its output is written.

    At the end of Python itself a thread that returns from torch to Python is unwound through C++ that forbids it, and
    the process aborts instead of ending with its status. So who serves previews from threads ends here, with all files
    closed.

    Args:
        status: Exit status of the process.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)
