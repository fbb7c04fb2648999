"""Atomic writing of files and folders, and a full disk as one line."""

import ctypes
import errno
import os
import shutil
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_NO_ROOM = {
    errno.ENOSPC: "the disk full",
    errno.EDQUOT: "the quota used up",
    errno.EFBIG: "a limit on the size of files",
}


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A binary stream that replaces `path` when the block succeeds; when it raises, `path` stays as it was.

    Raises: ValueError where the folder does not exist or `path` is a folder.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file name to write, found a folder")
    partial = path.with_name(f".{path.name}.partial")  # fixed: replaces what a killed write left
    try:
        with partial.open("wb") as stream:
            yield stream
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Generator[Path]:
    """A new folder that replaces `folder` when the block succeeds; when it raises, `folder` stays as it was.

    Leftovers of a killed run are restored or removed first.
    """
    new, old = (folder.with_name(f".{folder.name}.{kind}") for kind in ("new", "old"))
    if old.exists() and not folder.exists():
        old.rename(folder)
    for leftover in (new, old):
        shutil.rmtree(leftover, ignore_errors=True)
    new.mkdir(parents=True)
    try:
        yield new
        _flush(new)
        if not folder.exists():
            new.rename(folder)
        elif not _exchange(new, folder):
            folder.rename(old)
            new.rename(folder)
    finally:
        for leftover in (new, old):
            shutil.rmtree(leftover, ignore_errors=True)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two folders in one system call; False where the system has none."""
    at_fdcwd, rename_exchange = -100, 2  # linux/fcntl.h, linux/fs.h
    if sys.platform != "linux":
        return False
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    return rename is not None and rename(at_fdcwd, bytes(a), at_fdcwd, bytes(b), rename_exchange) == 0


def _flush(folder: Path) -> None:
    """Write all content to the disk before the rename, so that a power failure cannot leave empty files."""
    for path in [*folder.rglob("*"), folder]:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def room_on_disk(folder: Path) -> Generator[None]:
    """Turn errors of a block that writes `folder` and found no room on the disk into a ValueError of one line."""
    try:
        yield
    except Exception as error:
        found = next((_NO_ROOM[number] for number in _numbers(error)), None)
        if found is None:
            raise
        raise ValueError(
            f"{folder}: expected room to write the result, found {found}; earlier results are complete, and the same "
            f"command continues when there is room"
        ) from error


def _numbers(error: BaseException | None) -> Iterator[int]:
    """The system's error numbers that mean no room, of an error and of those that it came from.

    Writers in other languages hide the number or replace the error while they close the file; its text remains.
    """
    while error is not None:
        for number in _NO_ROOM:
            if getattr(error, "errno", None) == number or f"[Errno {number}]" in str(error):
                yield number
        error = error.__cause__ or error.__context__
