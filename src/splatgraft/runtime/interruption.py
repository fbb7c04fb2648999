"""Ctrl-C held back until a long loop can stop at the end of a step and save what it has."""

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interruption_held(*, terminate: bool = False) -> Generator[Callable[[], bool]]:
    """Hold back the first Ctrl-C within the block; the second one acts at once.

    Signals whose handler is not Python's own are left alone, and so are blocks in other threads than the main one.

    Args:
        terminate: Hold SIGTERM too where nothing handles it, as schedulers of clusters send it.

    Yields:
        Whether there was one; the block then saves its state and raises KeyboardInterrupt.
    """
    requested = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            before = signal.getsignal(number)
            unhandled = terminate and number == signal.SIGTERM and before is signal.SIG_DFL
            if before is signal.default_int_handler or unhandled:
                held[number] = before
    for number in held:
        signal.signal(number, hold)
    try:
        yield lambda: requested
    finally:
        for number, before in held.items():
            signal.signal(number, before)
    if requested:  # in the block's last moments
        raise KeyboardInterrupt
