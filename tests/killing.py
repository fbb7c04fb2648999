"""Simulate a kill in the process: from the n-th write on, no write reaches the disk, clean-up included."""

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager

_CHANGES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "os.truncate")


class Killed(BaseException):
    """Error of every write after the fatal one."""


class _State:
    writes_left: int | None = None
    """Number of writes left, None outside of a test."""


def _count(event: str, arguments: tuple) -> None:
    if _State.writes_left is None:
        return
    if event in _CHANGES or (event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)):
        _State.writes_left -= 1
        if _State.writes_left < 0:
            raise Killed


# an audit hook cannot be removed; it has no effect outside of the block below
sys.addaudithook(_count)


@contextmanager
def killed_at_write(number: int) -> Generator[None]:
    """Let `number` changes of the file system happen, and raise `Killed` in place of all later ones."""
    _State.writes_left = number
    try:
        yield
    finally:
        _State.writes_left = None
