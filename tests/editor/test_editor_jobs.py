"""Jobs in child processes: progress, cancellation, detection of killed processes, and time estimates."""

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from waiting import HANG_LIMIT, wait_until

from splatgraft.editor.jobs.jobs import Jobs, JobState, PlannedStep, seconds_left, seconds_left_in_job, write_state

WORK = """
import sys, os, signal, time
from pathlib import Path
from splatgraft.editor.jobs.jobs import JobState, acquire_job_lock, write_state
folder, release = Path(sys.argv[1]), Path(sys.argv[1]) / "release"
signal.signal(signal.SIGINT, signal.default_int_handler)
lock = acquire_job_lock(folder)
state = JobState("work", ("run",), os.getpid(), "running", time.time(), step="render", done=3, total=4)
write_state(folder, state)
try:
    while not release.exists():
        time.sleep(0.05)
    write_state(folder, JobState("work", ("run",), os.getpid(), "done", time.time()))
except KeyboardInterrupt:
    write_state(folder, JobState("work", ("run",), os.getpid(), "cancelled", time.time()))
"""


def start(folder: Path) -> Jobs:
    """Start a job that works until the file `release` exists."""
    jobs = Jobs(folder)
    jobs.start([sys.executable, "-c", WORK, str(folder)], title="work", shown=["run"])
    return jobs


def reap(jobs: Jobs) -> None:
    """Wait for the process, which ends after it has written its outcome."""
    assert jobs._child is not None
    jobs._child.wait(HANG_LIMIT)


def outcome(jobs: Jobs) -> str:
    state = jobs.state()
    return "" if state is None else state.outcome


def test_another_process_sees_a_running_job_and_its_end(tmp_path: Path) -> None:
    assert Jobs(tmp_path).state() is None
    jobs = start(tmp_path)
    other = Jobs(tmp_path)
    wait_until(lambda: outcome(other) == "running", what="work")
    state = other.state()
    assert state is not None
    assert state.fraction == 0.75
    with pytest.raises(ValueError, match="running"):
        other.start(["true"], title="another", shown=[])
    (tmp_path / "release").touch()
    wait_until(lambda: outcome(other) == "done", what="the end")
    assert outcome(jobs) == "done"
    reap(jobs)


def test_a_cancelled_job_has_that_outcome(tmp_path: Path) -> None:
    jobs = start(tmp_path)
    wait_until(lambda: outcome(jobs) == "running", what="work")
    jobs.cancel()
    wait_until(lambda: outcome(jobs) == "cancelled", what="the cancel")
    jobs.cancel()
    reap(jobs)


def test_a_killed_job_is_detected(tmp_path: Path) -> None:
    jobs = start(tmp_path)
    wait_until(lambda: outcome(jobs) == "running", what="work")
    state = jobs.state()
    assert state is not None
    os.kill(state.pid, signal.SIGKILL)
    wait_until(lambda: outcome(Jobs(tmp_path)) == "killed", what="the kill to be seen")
    wait_until(lambda: outcome(jobs) == "killed", what="the kill to be seen by the parent")
    reap(jobs)
    # and it does not block the next job
    (tmp_path / "release").touch()
    again = start(tmp_path)
    wait_until(lambda: outcome(again) == "done", what="the next")
    reap(again)


def test_the_remaining_time_is_extrapolated() -> None:
    state = JobState("work", (), 1, "running", 0.0, done=3, total=9, begun_at=100.0)
    assert seconds_left(state, 106.0) == 12.0
    assert seconds_left(state, 100.5) is None
    assert seconds_left(JobState("work", (), 1, "running", 0.0), time.time()) is None


def test_units_of_an_earlier_run_do_not_count_for_the_speed() -> None:
    state = JobState("work", (), 1, "running", 0.0, done=60, total=100, begun=50, begun_at=100.0)
    assert seconds_left(state, 120.0) == 80.0


def test_the_job_s_remaining_time_is_measured_or_not_said() -> None:
    plan = (PlannedStep("a", 10.0, True), PlannedStep("b", 4.0, True), PlannedStep("c", 6.0, True))
    state = JobState("work", (), 1, "running", 0.0, step="a", step_started=100.0, plan=plan)
    assert seconds_left_in_job(state, 103.0) == 7.0 + 4.0 + 6.0
    # the rate of the running step counts where it is slower than in the last run
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


def test_a_state_is_read_back_as_written(tmp_path: Path) -> None:
    plan = (PlannedStep("a", 1.5, True),)
    state = JobState("work", ("run",), os.getpid(), "done", 0.0, plan=plan)
    write_state(tmp_path, state)
    assert Jobs(tmp_path).state() == state
