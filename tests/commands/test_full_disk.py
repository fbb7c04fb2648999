"""Where there is no room on the disk, a run ends with one line, and what was there before is still whole."""

import errno
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_project import contents, copy_of

from splatgraft.cli import main
from splatgraft.commands.steps.render import Render
from splatgraft.project.step import Context
from splatgraft.workflow.flow import read_flow


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
            # as PyTorch's writer does while it closes the file
            raise RuntimeError("unexpected pos 64 vs 0")  # noqa: B904

    monkeypatch.setattr(Render, "write", write)
    out = read_flow(finished).steps["render"].out
    wanted = contents(out)
    assert main(["run", str(finished), "--to", "render", "--force", "render"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"splatgraft: {out}: expected room to write the result, found the disk full")
    assert contents(out) == wanted
    assert not list(finished.parent.rglob(".*.new"))


def run(project: Path, *words: str, most_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """`splatgraft run` with a limit on the size of each file."""

    def limited() -> None:
        if most_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    source = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src")}
    command = [sys.executable, "-m", "splatgraft", "run", str(project), *words]
    return subprocess.run(command, preexec_fn=limited, env=source, capture_output=True, text=True, check=False)


@pytest.mark.long
def test_files_beyond_the_limit_are_one_line_and_earlier_results_stay(finished: Path) -> None:
    wanted = {step.out: contents(step.out) for _, step in read_flow(finished)}
    # the largest files of these steps are some hundred kB (scenes), some kB (pictures) and some kB (turntable)
    for step, most in (("source/reconstruct", 20_000), ("render", 1_000), ("evaluate", 3_000)):
        done = run(finished, "--to", step, "--force", step, most_bytes=most)
        assert done.returncode == 2
        assert "Traceback" not in done.stderr
        last = done.stderr.splitlines()[-1]
        assert re.match(r"splatgraft: .*: expected room to write the result, found a limit on the size of files", last)
        assert str(read_flow(finished).steps[step].out) in last
        assert {folder: contents(folder) for folder in wanted} == wanted
        assert not list(finished.parent.rglob(".*.new"))
    assert run(finished).returncode == 0
    assert {folder: contents(folder) for folder in wanted} == wanted
