"""Atomic files: replaced when complete, unchanged after an error or a kill."""

import subprocess
import sys

import pytest

from splatgraft.runtime.files import atomic_write


def test_replaces_whole(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")
    with atomic_write(path) as stream:
        stream.write(b"aft")
        assert path.read_bytes() == b"before"
        stream.write(b"er")
    assert path.read_bytes() == b"after"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_kill_left_is_cleared(tmp_path):
    code = "import os, sys, pathlib, splatgraft.runtime.files as w\n"
    code += "with w.atomic_write(pathlib.Path(sys.argv[1])) as s: s.write(b'half'); s.flush(); os.kill(os.getpid(), 9)"
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")
    subprocess.run([sys.executable, "-c", code, str(path)], check=False, timeout=60)
    assert path.read_bytes() == b"before"
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_write(path) as stream:
        stream.write(b"after")
    assert path.read_bytes() == b"after"
    assert list(tmp_path.iterdir()) == [path]


def test_failure_keeps_what_was_there(tmp_path):
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


def test_where_nothing_can_be_written(tmp_path):
    with (
        pytest.raises(ValueError, match=r"a\.bin: expected an existing folder"),
        atomic_write(tmp_path / "no" / "a.bin"),
    ):
        pass
    with pytest.raises(ValueError, match="expected a file name to write, found a folder"), atomic_write(tmp_path):
        pass
