"""A command without room on the disk, or without the right to write, ends with one line and keeps earlier files."""

import ctypes
import errno
import os
import re
import resource
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tiny_project import contents, copy_of

from splatgraft.cli import main
from splatgraft.project.step import Context
from splatgraft.steps.render import Render
from splatgraft.workflow.flow import read_flow


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Limit the size of every file to this many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Remove the right to write into a folder, also for root."""
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for path in folders:
        path.chmod(0o555)
    try:
        with heeding_permissions():
            with pytest.raises(PermissionError):
                (folder / "new").touch()
            yield
    finally:
        for path in folders:
            path.chmod(0o755)


@contextmanager
def heeding_permissions() -> Iterator[None]:
    """Make this thread obey file permissions, as root does without two of its capabilities."""
    if os.geteuid() != 0:
        yield
        return
    if sys.platform != "linux":
        pytest.skip("root heeds no permissions")
    libc, header = ctypes.CDLL(None, use_errno=True), struct.pack("<Ii", 0x20080522, 0)
    had = ctypes.create_string_buffer(24)  # linux/capability.h: two of effective, permitted, inheritable
    assert libc.capget(header, had) == 0
    effective, *others = struct.unpack("<6I", had.raw)
    # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH
    assert libc.capset(header, struct.pack("<6I", effective & ~0b110, *others)) == 0
    try:
        yield
    finally:
        assert libc.capset(header, had.raw) == 0


@pytest.fixture(scope="module")
def finished(finished_project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_of(finished_project, tmp_path_factory.mktemp("full")) / "project.toml"


def test_a_writer_without_room_is_one_line_and_the_earlier_result_stays(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(self: Render, folder: Path, context: Context) -> None:
        (folder / "half").write_text("half")
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError:
            # like PyTorch's writer, which raises this while it closes the file
            raise RuntimeError("unexpected pos 64 vs 0")  # noqa: B904

    monkeypatch.setattr(Render, "write", write)
    out = read_flow(finished).steps["render"].out
    wanted = contents(out)
    assert main(["run", str(finished), "--to", "render", "--force", "render"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(
        f"splatgraft: {out}: expected room to write it, found no space left on the disk; earlier results are complete"
    )
    assert contents(out) == wanted
    assert not list(finished.parent.rglob(".*.new"))


@pytest.mark.parametrize(
    ("name", "most"), [("a.ply", 999), ("a.sog", 999), ("a.gif", 999), ("a.mp4", 99), ("a.mp4", 6000)]
)
def test_an_export_without_room_is_one_line_and_leaves_nothing(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, most: int
) -> None:
    with files_of_at_most(most):
        assert main(["export", str(finished), "--to", str(tmp_path / name)]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    # OpenCV does not say why it wrote less
    found = r"found (a limit on the size of files|\d+ written, with .* on the disk)"
    assert re.match(rf"splatgraft: {tmp_path / name}: expected .*, {found}$", last), last
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_project_is_up_to_date_or_says_what_it_cannot_write(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project, capture = finished.parent, str(finished.parents[1] / "photos" / "source")
    (project / "source" / ".scene.new").mkdir()  # as after a kill
    commands = {
        "views": ["run", str(finished), "--force", "render"],
        ".edit.lock": ["edit", str(project)],
        "a.ply": ["export", str(finished), "--to", str(project / "a.ply")],
        "a.mp4": ["export", str(finished), "--to", str(project / "a.mp4")],
        "new": ["init", str(project / "new"), "--source", capture, "--target", capture],
    }
    with read_only(project):
        assert main(["run", str(finished)]) == 0
        assert capsys.readouterr().out.splitlines()[-1] == str(project / "report" / "index.html")
        for name, words in commands.items():
            assert main(words) == 2
            last = capsys.readouterr().err.splitlines()[-1]
            assert re.match(
                rf"splatgraft: {project}/{name}: expected .*, found:? (a read-only folder|permission denied)", last
            )
    (project / "source" / ".scene.new").rmdir()


@pytest.mark.long
def test_files_beyond_the_limit_are_one_line_and_earlier_results_stay(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = {step.out: contents(step.out) for _, step in read_flow(finished)}
    # the largest files of these steps are some hundred kB (scenes), some kB (pictures) and some kB (turntable)
    for step, most in (("source/reconstruct", 20_000), ("render", 1_000), ("evaluate", 3_000)):
        with files_of_at_most(most):
            assert main(["run", str(finished), "--to", step, "--force", step]) == 2
        last = capsys.readouterr().err.splitlines()[-1]
        assert re.match(r"splatgraft: .*: expected room to write it, found a limit on the size of files", last)
        assert str(read_flow(finished).steps[step].out) in last
        assert {folder: contents(folder) for folder in wanted} == wanted
        assert not list(finished.parent.rglob(".*.new"))
    assert main(["run", str(finished)]) == 0
    assert {folder: contents(folder) for folder in wanted} == wanted
