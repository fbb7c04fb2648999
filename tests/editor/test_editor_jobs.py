"""Jobs in child processes: progress, cancellation, detection of killed processes, and time estimates."""

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from editor_driver import wait_until

from splatgraft.editor.jobs.jobs import Jobs, JobState, PlannedStep, seconds_left, seconds_left_in_job, write_state

WORK = """
import sys, os, signal, time
from pathlib import Path
from splatgraft.editor.jobs.jobs import JobState, acquire_job_lock, write_state
folder, seconds = Path(sys.argv[1]), float(sys.argv[2])
signal.signal(signal.SIGINT, signal.default_int_handler)
lock = acquire_job_lock(folder)
state = JobState("work", ("run",), os.getpid(), "running", time.time(), step="render", done=3, total=4)
write_state(folder, state)
try:
    time.sleep(seconds)
    write_state(folder, JobState("work", ("run",), os.getpid(), "done", time.time()))
except KeyboardInterrupt:
    write_state(folder, JobState("work", ("run",), os.getpid(), "cancelled", time.time()))
"""


def start(folder: Path, seconds: float) -> Jobs:
    jobs = Jobs(folder)
    jobs.start([sys.executable, "-c", WORK, str(folder), str(seconds)], title="work", shown=["run"])
    return jobs


def reap(jobs: Jobs) -> None:
    """Wait for the process, which ends a moment after its last word."""
    assert jobs._child is not None
    jobs._child.wait(30)


def outcome(jobs: Jobs) -> str:
    state = jobs.state()
    return "" if state is None else state.outcome


def test_a_job_is_seen_at_work_by_another_and_ends(tmp_path: Path) -> None:
    assert Jobs(tmp_path).state() is None
    jobs = start(tmp_path, 1.0)
    other = Jobs(tmp_path)
    wait_until(lambda: outcome(other) == "running", timeout=30, what="work")
    state = other.state()
    assert state is not None
    assert state.fraction == 0.75
    with pytest.raises(ValueError, match="running"):
        other.start(["true"], title="another", shown=[])
    wait_until(lambda: outcome(other) == "done", timeout=30, what="the end")
    assert outcome(jobs) == "done"
    reap(jobs)


def test_a_cancelled_job_says_so(tmp_path: Path) -> None:
    jobs = start(tmp_path, 60)
    wait_until(lambda: outcome(jobs) == "running", timeout=30, what="work")
    jobs.cancel()
    wait_until(lambda: outcome(jobs) == "cancelled", timeout=30, what="the cancel")
    jobs.cancel()
    reap(jobs)


def test_a_killed_job_is_not_taken_for_one_at_work(tmp_path: Path) -> None:
    jobs = start(tmp_path, 60)
    wait_until(lambda: outcome(jobs) == "running", timeout=30, what="work")
    state = jobs.state()
    assert state is not None
    os.kill(state.pid, signal.SIGKILL)
    wait_until(lambda: outcome(Jobs(tmp_path)) == "killed", timeout=30, what="the kill to be seen")
    wait_until(lambda: outcome(jobs) == "killed", timeout=30, what="the kill to be seen by the parent")
    reap(jobs)
    # and does not stand in the way of the next
    again = start(tmp_path, 0)
    wait_until(lambda: outcome(again) == "done", timeout=30, what="the next")
    reap(again)


def test_the_time_left_goes_on_as_it_has() -> None:
    state = JobState("work", (), 1, "running", 0.0, done=3, total=9, begun_at=100.0)
    assert seconds_left(state, 106.0) == 12.0
    assert seconds_left(state, 100.5) is None
    assert seconds_left(JobState("work", (), 1, "running", 0.0), time.time()) is None


def test_what_an_earlier_run_did_took_no_time_now() -> None:
    state = JobState("work", (), 1, "running", 0.0, done=60, total=100, begun=50, begun_at=100.0)
    assert seconds_left(state, 120.0) == 80.0


def test_the_time_left_in_all_counts_on_what_was_measured_and_mends_what_was_guessed() -> None:
    plan = (PlannedStep("a", 10.0, True), PlannedStep("b", 4.0, False), PlannedStep("c", 6.0, False))
    state = JobState("work", (), 1, "running", 0.0, step="a", step_started=100.0, plan=plan)
    assert seconds_left_in_job(state, 103.0) == 7.0 + 4.0 + 6.0
    # its own progress is the better witness, and a measured step says nothing about the guesses
    assert seconds_left_in_job(replace(state, done=1, total=4, begun_at=100.0), 105.0) == 15.0 + 4.0 + 6.0
    # but what it counts may be one of several things
    assert seconds_left_in_job(replace(state, done=3, total=4, begun_at=100.0), 103.0) == 7.0 + 4.0 + 6.0
    # b takes twice what was guessed: so will c
    later = replace(state, step="b", step_started=110.0, begun_at=110.0, done=1, total=2, took=(("a", 10.0),))
    assert seconds_left_in_job(later, 114.0) == 4.0 + 12.0
    assert seconds_left_in_job(replace(later, step="c", took=(("a", 10.0), ("b", 8.0)), done=0), 111.0) == 11.0
    # at the end of what it counts it is not known what else there is
    assert seconds_left(replace(later, done=2), 114.0) is None
    # nothing is known of the first step, or of the job
    assert seconds_left_in_job(replace(state, plan=plan[1:], step="b"), 103.0) is None
    assert seconds_left_in_job(replace(state, plan=()), 103.0) is None
    assert seconds_left_in_job(replace(state, outcome="done"), 103.0) is None


def test_the_plan_survives_its_file(tmp_path: Path) -> None:
    plan, took = (PlannedStep("a", 1.5, True),), (("b", 2.5),)
    state = JobState("work", ("run",), os.getpid(), "done", 0.0, plan=plan, took=took)
    write_state(tmp_path, state)
    assert Jobs(tmp_path).state() == state
