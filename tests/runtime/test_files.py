"""Atomic files: replaced when complete, unchanged after an error or a kill."""

import errno
import os
from types import SimpleNamespace

import pytest
from killing import Killed, killed_at_write

from splatgraft.runtime import files
from splatgraft.runtime.files import atomic_write


def test_failure_keeps_what_was_there_and_what_a_kill_left_is_cleared(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")

    def write_half():
        with atomic_write(path) as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
    # the partial file is opened, and its renaming never happens
    with pytest.raises(Killed), killed_at_write(1), atomic_write(path) as stream:
        stream.write(b"half")
    assert path.read_bytes() == b"before"
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_write(path) as stream:
        stream.write(b"after")
        assert path.read_bytes() == b"before"
    assert path.read_bytes() == b"after"
    assert list(tmp_path.iterdir()) == [path]


def test_where_nothing_can_be_written(tmp_path):
    with (
        pytest.raises(ValueError, match=r"a\.bin: expected an existing folder"),
        atomic_write(tmp_path / "no" / "a.bin"),
    ):
        pass
    with pytest.raises(ValueError, match="expected a file name to write, found a folder"), atomic_write(tmp_path):
        pass


def test_a_folder_is_replaced_on_windows(tmp_path, monkeypatch):
    """Windows opens no folders, and flushes only files that are open for writing."""
    opened: dict[int, int] = {}

    def open_as_windows(path, flags):
        if os.path.isdir(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        descriptor = os.open(path, flags)
        opened[descriptor] = flags
        return descriptor

    def flush_as_windows(descriptor):
        if not opened[descriptor] & os.O_RDWR:
            raise OSError(errno.EBADF, "Bad file descriptor")
        flushed.append(descriptor)

    flushed: list[int] = []
    with monkeypatch.context() as windows:
        windows.setattr(files, "sys", SimpleNamespace(platform="win32"))
        own = {"open": open_as_windows, "fsync": flush_as_windows}
        windows.setattr(files, "os", SimpleNamespace(**{**vars(os), **own}))
        for text in ("first", "second"):
            with files.atomic_folder(tmp_path / "result") as folder:
                (folder / "inner").mkdir()
                (folder / "inner" / "a.txt").write_text(text)
    assert (tmp_path / "result" / "inner" / "a.txt").read_text() == "second"
    assert len(flushed) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
