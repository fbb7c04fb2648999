"""Atomic writing of files and folders, and one line on what cannot be written: a full disk, a read-only folder."""

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
    errno.ENOSPC: "no space left on the disk",
    errno.EDQUOT: "the quota used up",
    errno.EFBIG: "a limit on the size of files",
    errno.EROFS: "a read-only disk",
}
_NO_RIGHT = {errno.EACCES: "a read-only folder", errno.EPERM: "a read-only folder"}
"""Only of what is known to write: a file that may not be read has the same numbers."""


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A binary stream that replaces `path` when the block succeeds; when it raises, `path` stays as it was.

    Raises: ValueError where the folder does not exist or cannot be written, `path` is a folder, or there is no room.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file name to write, found a folder")
    partial = path.with_name(f".{path.name}.partial")  # fixed: replaces what a killed write left
    with writable(path):
        stream = partial.open("wb")
    try:
        with room_on_disk(path), stream:
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
    with writable(folder):
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


def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the one in which it would be made."""
    return os.access(next(path for path in (folder, *folder.parents) if path.exists()), os.W_OK)


@contextmanager
def writable(path: Path) -> Generator[None]:
    """Turn the errors of a block that does no more than make `path`, where it cannot, into a ValueError of one line."""
    try:
        yield
    except OSError as error:
        found = (_NO_ROOM | _NO_RIGHT).get(error.errno or 0)
        if found is None:
            raise
        raise ValueError(f"{path}: expected to write it, found {found}") from error


@contextmanager
def room_on_disk(path: Path, otherwise: str = "") -> Generator[None]:
    """Turn errors of a block that writes `path` and found no room on the disk into a ValueError of one line.

    `otherwise` ends the line: what becomes of the work.
    """
    try:
        yield
    except Exception as error:
        found = next((_NO_ROOM[number] for number in _numbers(error)), None)
        if found is None:
            raise
        raise ValueError(f"{path}: expected room to write it, found {found}{otherwise}") from error


def os_error_line(error: OSError) -> str:
    """An error of the system, in words: the file, where it has one, and what was found."""
    if error.filename is None or error.strerror is None:
        return " ".join(str(error).split())
    return f"{error.filename}: expected a file that can be read and written, found: {error.strerror.lower()}"


def _numbers(error: BaseException | None) -> Iterator[int]:
    """The system's error numbers that mean no room, of an error and of those that it came from.

    Writers in other languages hide the number or replace the error while they close the file; its text remains.
    """
    while error is not None:
        for number in _NO_ROOM:
            if getattr(error, "errno", None) == number or f"[Errno {number}]" in str(error):
                yield number
        error = error.__cause__ or error.__context__
