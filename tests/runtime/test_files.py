"""Atomic files: replaced when complete, unchanged after an error or a kill."""

import pytest
from killing import Killed, killed_at_write

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
