"""Ctrl-C held back until a long loop can stop at the end of a step and save what it has."""

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interruption_held() -> Generator[Callable[[], bool]]:
    """Hold back the first Ctrl-C within the block; the second one acts at once.

    Signals whose handler is not Python's own are left alone, and so are blocks in other threads than the main one.

    Yields:
        Whether there was one; the block then saves its state and raises KeyboardInterrupt.
    """
    requested = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    held: list[int] = []
    if threading.current_thread() is threading.main_thread():
        held = [number for number in _SIGNALS if signal.getsignal(number) is signal.default_int_handler]
    for number in held:
        signal.signal(number, hold)
    try:
        yield lambda: requested
    finally:
        for number in held:
            signal.signal(number, signal.default_int_handler)
    if requested:  # in the block's last moments
        raise KeyboardInterrupt
