"""Atomic files: replaced when complete, unchanged after an error or a kill."""

import errno
import ntpath
import os
from pathlib import PureWindowsPath
from types import SimpleNamespace

import pytest
from killing import Killed, killed_at_write

from splatgraft.runtime import files
from splatgraft.runtime.files import atomic_write, relative_name


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
    """Windows cannot exchange two folders, and flushes only files that are open for writing."""
    fcntl = pytest.importorskip("fcntl")

    def flush_as_windows(descriptor):
        if not fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_RDWR:
            raise OSError(errno.EBADF, "Bad file descriptor")
        flushed.append(descriptor)

    flushed: list[int] = []
    with monkeypatch.context() as windows:
        windows.setattr(files, "sys", SimpleNamespace(platform="win32"))
        windows.setattr(files, "os", SimpleNamespace(**{**vars(os), "fsync": flush_as_windows}))
        for text in ("first", "second"):
            with files.atomic_folder(tmp_path / "result") as folder:
                (folder / "inner").mkdir()
                (folder / "inner" / "a.txt").write_text(text)
    assert (tmp_path / "result" / "inner" / "a.txt").read_text() == "second"
    assert len(flushed) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_a_relative_name_has_forward_slashes_and_is_absolute_on_another_drive(tmp_path, monkeypatch):
    assert relative_name(tmp_path / "photos" / "vase", tmp_path / "garden") == "../photos/vase"
    with monkeypatch.context() as windows:
        windows.setattr(files, "os", SimpleNamespace(path=ntpath, sep=ntpath.sep))
        photos = PureWindowsPath("C:/photos/vase")
        assert relative_name(photos, PureWindowsPath("C:/projects/garden")) == "../../photos/vase"
        assert relative_name(photos, PureWindowsPath("D:/garden")) == "C:/photos/vase"
