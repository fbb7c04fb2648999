"""A file appears whole or not at all."""

import subprocess
import sys

import pytest

from splatgraft.whole_file import whole_file


def test_replaces_whole(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")
    with whole_file(path) as stream:
        stream.write(b"aft")
        assert path.read_bytes() == b"before"
        stream.write(b"er")
    assert path.read_bytes() == b"after"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_kill_left_is_cleared(tmp_path):
    code = "import os, sys, pathlib, splatgraft.whole_file as w\n"
    code += "with w.whole_file(pathlib.Path(sys.argv[1])) as s: s.write(b'half'); s.flush(); os.kill(os.getpid(), 9)"
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")
    subprocess.run([sys.executable, "-c", code, str(path)], check=False, timeout=60)
    assert path.read_bytes() == b"before"
    assert len(list(tmp_path.iterdir())) == 2
    with whole_file(path) as stream:
        stream.write(b"after")
    assert path.read_bytes() == b"after"
    assert list(tmp_path.iterdir()) == [path]


def test_failure_keeps_what_was_there(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")

    def write_half():
        with whole_file(path) as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_where_nothing_can_be_written(tmp_path):
    with pytest.raises(ValueError, match=r"a\.bin: expected an existing folder"), whole_file(tmp_path / "no" / "a.bin"):
        pass
    with pytest.raises(ValueError, match="expected a file name to write, found a folder"), whole_file(tmp_path):
        pass
