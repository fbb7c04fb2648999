"""`python benchmarks/exam NUMBER`; `python benchmarks/exam --help` lists the options."""

import sys
from pathlib import Path


def _run() -> None:
    # a folder that is run is itself the first import path; its modules are imported as `exam.NAME`
    sys.path[0] = str(Path(__file__).resolve().parent.parent)
    from exam.command import main

    sys.exit(main())


if __name__ == "__main__":
    _run()
