"""Jobs in child processes: progress, cancel, detection of killed processes, time estimates; files to share."""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock, patch

import pytest
from small_transfer import write_transfer
from waiting import HANG_LIMIT, wait_until

from splatgraft.cli import main
from splatgraft.editor import jobs as editor_jobs
from splatgraft.editor import result_panels as sharing
from splatgraft.editor.jobs import Jobs, JobState, seconds_left, seconds_left_in_job, write_state
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.exports.export import EXPORT_SUFFIXES
from splatgraft.project.step_table import PlannedStep

WORK = """
import sys, os, signal, time
from pathlib import Path
from splatgraft.editor.jobs import JobState, write_state
from splatgraft.project.step import locked
folder, release = Path(sys.argv[1]), Path(sys.argv[1]) / "release"
signal.signal(signal.SIGINT, signal.default_int_handler)
with locked(folder / "job"):
    state = JobState("work", ("run",), os.getpid(), "running", step="render", done=3, total=4)
    write_state(folder, state)
    try:
        while not release.exists():
            time.sleep(0.05)
        write_state(folder, JobState("work", ("run",), os.getpid(), "done"))
    except KeyboardInterrupt:
        write_state(folder, JobState("work", ("run",), os.getpid(), "cancelled"))
"""


def start(folder: Path) -> Jobs:
    """Start a job that works until the file `release` exists."""
    jobs = Jobs(folder)
    with patch.object(editor_jobs, "_PROGRAM", (sys.executable, "-c", WORK)):
        jobs.start(["run"], "work")
    return jobs


def ends(jobs: Jobs, outcome: str) -> None:
    """Wait for the outcome of a job, as seen by another process too, and for the end of its process."""
    for seen in (jobs, Jobs(jobs.folder)):
        wait_until(lambda seen=seen: (state := seen.state()) is not None and state.outcome == outcome, what=outcome)
    assert jobs._child is not None
    jobs._child.wait(HANG_LIMIT)


def test_another_process_sees_a_job_at_work_and_its_end(tmp_path: Path) -> None:
    assert Jobs(tmp_path).state() is None
    jobs, other = start(tmp_path), Jobs(tmp_path)
    state = other.state()
    assert state is not None
    assert state.fraction == 0.75
    with pytest.raises(ValueError, match="running"):
        other.start(["run"], "another")
    (tmp_path / "release").touch()
    ends(jobs, "done")


def test_cancelled_and_killed_jobs_have_that_outcome(tmp_path: Path) -> None:
    jobs = start(tmp_path)
    jobs.cancel()
    ends(jobs, "cancelled")
    jobs.cancel()
    jobs = start(tmp_path)
    state = jobs.state()
    assert state is not None
    os.kill(state.pid, signal.SIGKILL)
    ends(jobs, "killed")
    # and it does not block the next job
    (tmp_path / "release").touch()
    ends(start(tmp_path), "done")


def test_the_remaining_time_is_measured_or_not_said() -> None:
    state = JobState("work", (), 1, "running", done=3, total=9, begun_at=100.0)
    assert seconds_left(state, 106.0) == 12.0
    assert seconds_left(state, 100.5) is None
    assert seconds_left(JobState("work", (), 1, "running"), 100.0) is None
    # units of an earlier run do not count for the speed
    assert seconds_left(replace(state, done=60, total=100, begun=50), 120.0) == 80.0
    plan = (PlannedStep("a", 10.0, True), PlannedStep("b", 4.0, True), PlannedStep("c", 6.0, True))
    state = JobState("work", (), 1, "running", step="a", step_started=100.0, plan=plan)
    assert seconds_left_in_job(state, 103.0) == 7.0 + 4.0 + 6.0
    # the rate of the running step counts if it is slower than in the last run
    assert seconds_left_in_job(replace(state, done=1, total=4, begun_at=100.0), 105.0) == 15.0 + 4.0 + 6.0
    # the counter may be one of several of the step
    assert seconds_left_in_job(replace(state, done=3, total=4, begun_at=100.0), 103.0) == 7.0 + 4.0 + 6.0
    # a default duration of a later step is a guess
    guessed = (*plan[:2], PlannedStep("c", 6.0, False))
    assert seconds_left_in_job(replace(state, plan=guessed), 103.0) is None
    # a step without a measured duration counts by its rate alone
    later = replace(state, plan=(PlannedStep("b", 4.0, False), plan[2]), step="b", step_started=110.0)
    assert seconds_left_in_job(later, 114.0) is None
    later = replace(later, begun_at=110.0, done=1, total=2)
    assert seconds_left_in_job(later, 114.0) == 4.0 + 6.0
    # longer than in the last run, and no rate
    assert seconds_left_in_job(replace(state, step="c"), 120.0) is None
    # at the end of a counter the rest is not known
    assert seconds_left(replace(later, done=2), 114.0) is None
    assert seconds_left_in_job(replace(state, plan=()), 103.0) is None
    assert seconds_left_in_job(replace(state, outcome="done"), 103.0) is None


def test_a_state_is_read_back_as_written_and_a_damaged_one_does_not_prevent_another_job(tmp_path: Path) -> None:
    state = JobState("work", ("run",), os.getpid(), "done", plan=(PlannedStep("a", 1.5, True),))
    write_state(tmp_path, state)
    jobs = Jobs(tmp_path)
    assert jobs.state() == state
    for text in ("{", "7", '{"pid": 0}', json.dumps(JobState("a", (), 0, "running").__dict__)):
        (tmp_path / "job.json").write_text(text)
        assert jobs.state() is None
    # a process that ends without a message counts as killed
    with patch.object(editor_jobs, "_PROGRAM", ("true",)):
        jobs.start([], "next")
    state = jobs.state()
    assert state is not None
    assert (state.title, state.outcome) == ("next", "killed")


# files to share


@pytest.fixture
def result(tmp_path: Path) -> Session:
    """Return a project after a run of all steps."""
    root = write_transfer(tmp_path)
    (root / "project.toml").write_text('[source]\ncapture = "photos"\n[target]\ncapture = "photos"\n')
    return Session(Project(root / "project.toml"))


def written(session: Session, kind: str, part: str) -> tuple[Path, JobState]:
    """Do the work of a job's process in this one."""
    layer = sharing.PARTS[part]
    to = sharing.export_path(session.files, kind, layer)
    to.parent.mkdir(parents=True, exist_ok=True)
    session.jobs.folder.mkdir(parents=True, exist_ok=True)
    words = session.project.export_words(to, layer)
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    status = editor_jobs.main([str(session.jobs.folder), "Write it", *words])
    for number, handler in zip((signal.SIGINT, signal.SIGTERM), handlers, strict=True):
        signal.signal(number, handler)
    job = session.jobs.state()
    assert job is not None
    assert status == (0 if job.outcome == "done" else 2)
    return to, job


@pytest.mark.long
def test_a_job_writes_what_the_command_writes(result: Session, tmp_path: Path) -> None:
    to, job = written(result, "Scene, small (.sog)", "object with shadow")
    assert to == result.files.root / "export" / "a_ball_on_a_plane_object_with_shadow.sog"
    assert job.outcome == "done", job.error
    assert main([*job.command[:3], str(tmp_path / "b.sog"), *job.command[4:]]) == 0
    assert to.read_bytes() == (tmp_path / "b.sog").read_bytes()
    assert job.command[4:] == ("--layer", "object-with-shadow")
    # what was assumed, then size and time
    assert "black Gaussians that darken the picture behind them" in job.said[0]
    assert job.said[-1].startswith(f"{to}: 0.0 MB in ")
    assert sharing.written_exports(result.files) == (to,)


def test_what_cannot_be_written_is_the_error_of_the_job(result: Session) -> None:
    result.files.relit.parent.joinpath("is_object.npy").unlink()
    to, job = written(result, "Scene, small (.sog)", "object alone")
    assert job.outcome == "failed"
    assert "expected" in job.error
    assert job.said == ()
    assert not to.exists()


def test_missing_results_and_packages_are_said(result: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(sharing.SHARE_KINDS.values()) == set(EXPORT_SUFFIXES)
    page = next(iter(sharing.SHARE_KINDS))
    assert "no report yet" in (sharing.why_not(result.files, sharing.REPORT) or "")
    result.files.result.unlink()
    # the light transfer alone can be shared before consolidation
    assert sharing.step_shown(result.files, is_report=False) == "relight"
    assert sharing.why_not(result.files, page) is None
    result.files.relit.unlink()
    assert "no result yet" in (sharing.why_not(result.files, page) or "")
    monkeypatch.setattr(sharing, "find_spec", lambda name: None)
    optional = "Scene, small (.spz)"
    assert "pip install 'splatgraft[" in (sharing.why_not(result.files, optional) or "")


def test_only_shared_files_and_the_report_are_served(result: Session) -> None:
    root = result.files.root
    (root / "export").mkdir()
    result.files.report.mkdir()
    (result.files.report / "index.html").touch()
    for name in ("a.sog", ".a.partial.mp4"):
        (root / "export" / name).touch()
    (root / "export" / "out").symlink_to(root / "project.toml")
    assert sharing.served_file(result.files, "export/a.sog") == root / "export" / "a.sog"
    assert sharing.served_file(result.files, "index.html") == result.files.report / "index.html"
    for name in ("export/.a.partial.mp4", "export/../project.toml", "export/out", "../project.toml", "export/", ""):
        assert sharing.served_file(result.files, name) is None


def test_the_first_stale_step_is_named(result: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def why(**given: str | None) -> str | None:
        monkeypatch.setattr(Project, "reasons", lambda self: given)
        return result.why_stale("consolidate")

    assert why(relight=None, consolidate=None) is None
    assert why(relight="options changed", render="waits for relight", consolidate="waits for render") == (
        "relight: options changed"
    )
    monkeypatch.setattr(Project, "reasons", MagicMock(side_effect=ValueError("project.toml: expected TOML")))
    assert result.why_stale("consolidate") == "project.toml: expected TOML"
