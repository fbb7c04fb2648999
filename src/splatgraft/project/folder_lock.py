"""A lock on a folder that the operating system releases when its process ends."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import filelock


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Lock `folder` for this process.

    Raises:
        ValueError: Another process holds the lock.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        raise ValueError(f"{folder}: expected no other run at work here, found one; wait for it or end it") from error
    try:
        yield
    finally:
        lock.release()
