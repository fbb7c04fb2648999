"""Atomic writing of files and folders, and errors in one line: a full disk, a read-only folder."""

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
"""Valid only for errors of writing, because unreadable files have the same numbers."""


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a binary stream that replaces `path` when the block succeeds; if the block raises, `path` is unchanged.

    Raises: ValueError if the folder does not exist or cannot be written, `path` is a folder, or there is no room.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file name to write, found a folder")
    partial = path.with_name(f".{path.name}.partial")  # a fixed name, to replace the rest of a killed write
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
    """Make a new folder that replaces `folder` when the block succeeds; if the block raises, `folder` is unchanged.

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
    """Exchange two folders in one system call; returns False if the system has none."""
    at_fdcwd, rename_exchange = -100, 2  # linux/fcntl.h, linux/fs.h
    if sys.platform != "linux":
        return False
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    return rename is not None and rename(at_fdcwd, bytes(a), at_fdcwd, bytes(b), rename_exchange) == 0


def _flush(folder: Path) -> None:
    """Write all files to the disk before the rename, so that a power failure cannot leave empty files."""
    for path in filter(Path.is_file, folder.rglob("*")):  # Windows opens no folders
        with path.open("r+b") as stream:  # Windows flushes only files that are open for writing
            os.fsync(stream.fileno())


def relative_name(path: Path, folder: Path) -> str:
    """Return the name of `path` relative to `folder`, with forward slashes; absolute if Windows has no relative one."""
    try:
        name = os.path.relpath(path, folder)
    except ValueError:  # on another drive
        name = os.path.abspath(path)
    return name.replace(os.sep, "/")


def is_writable(folder: Path) -> bool:
    """Return whether files can be made in a folder, or in its nearest existing parent."""
    return os.access(next(path for path in (folder, *folder.parents) if path.exists()), os.W_OK)


@contextmanager
def writable(path: Path) -> Generator[None]:
    """Turn errors of a block that only makes `path` into a ValueError of one line, if `path` cannot be written."""
    try:
        yield
    except OSError as error:
        found = (_NO_ROOM | _NO_RIGHT).get(error.errno or 0)
        if found is None:
            raise
        raise ValueError(f"{path}: expected to write it, found {found}") from error


@contextmanager
def room_on_disk(path: Path, otherwise: str = "") -> Generator[None]:
    """Turn errors for lack of room on the disk, in a block that writes `path`, into a ValueError of one line.

    `otherwise` ends the line; it says how to continue the work.
    """
    try:
        yield
    except Exception as error:
        found = next((_NO_ROOM[number] for number in _numbers(error)), None)
        if found is None:
            raise
        raise ValueError(f"{path}: expected room to write it, found {found}{otherwise}") from error


def is_disk_full(error: BaseException) -> bool:
    """Return whether an error, or one of its causes, was that the disk or the user's quota is full."""
    return any(number in (errno.ENOSPC, errno.EDQUOT) for number in _numbers(error))


def os_error_line(error: OSError) -> str:
    """Describe an error of the system: the file, if it names one, and the cause."""
    if error.filename is None or error.strerror is None:
        return " ".join(str(error).split())
    return f"{error.filename}: expected a file that can be read and written, found: {error.strerror.lower()}"


def _numbers(error: BaseException | None) -> Iterator[int]:
    """Yield the system's numbers for lack of room, of an error and of its causes.

    Writers in other languages hide the number or replace the error while they close the file, but keep its text.
    """
    while error is not None:
        for number in _NO_ROOM:
            if getattr(error, "errno", None) == number or f"[Errno {number}]" in str(error):
                yield number
        error = error.__cause__ or error.__context__
