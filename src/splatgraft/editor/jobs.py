"""Jobs: child processes that outlive the page and the server and report progress in a state file.

A lock file shows whether the process of a job is alive.
"""

import json
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import filelock

from splatgraft.project.step_table import PlannedStep
from splatgraft.runtime.files import atomic_write, writable

_STATE_FILE, _LOG_FILE, _LOCK_FILE = "job.json", "job.log", "job.lock"
Outcome = Literal["running", "done", "failed", "cancelled", "killed"]
_WAIT = 0.02
"""Seconds between reads of the state file while a job starts."""
_MIN_SPENT = 2.0
"""Seconds after which a counter's rate is known."""


@dataclass(frozen=True)
class JobState:
    """Progress of a job, as last written by its process."""

    title: str
    """Title for the user."""
    command: tuple[str, ...]
    """Arguments of the equivalent `splatgraft` command."""
    pid: int
    """Process id; the process leads its own process group."""
    outcome: Outcome
    """Outcome; `killed`: the process ended without writing one."""
    started: float
    """Time of the start, seconds since 1970."""
    step: str = ""
    """The running step."""
    done: int = 0
    """Finished units of the running step."""
    total: int = 0
    """Total units of the running step; 0 if not known yet."""
    message: str = ""
    """Progress message of the step."""
    step_started: float = 0.0
    """Start of the running step, seconds since 1970."""
    begun: int = 0
    """Units that an earlier, killed run had finished when counting began."""
    begun_at: float = 0.0
    """Start of the current counter, seconds since 1970; a step may have several counters."""
    error: str = ""
    """Error message, one line; empty unless the outcome is `failed`."""
    plan: tuple[PlannedStep, ...] = ()
    """All steps of the job in order; empty if they are not known."""
    said: tuple[str, ...] = ()
    """Sentences for the user about the results; empty before the outcome `done`."""

    @property
    def live(self) -> bool:
        """Whether the job is running."""
        return self.outcome == "running"

    @property
    def fraction(self) -> float:
        """Finished fraction of the running step, in [0, 1]."""
        return min(1.0, self.done / self.total) if self.total else 0.0


def seconds_left(state: JobState, now: float) -> float | None:
    """Estimate the seconds until the step's counter is complete from its rate so far; None if it is too early."""
    spent, done = now - state.begun_at, state.done - state.begun
    if not state.live or not 0 < done < state.total - state.begun or spent < _MIN_SPENT:
        return None
    return spent * (state.total - state.done) / done


def seconds_left_in_job(state: JobState, now: float) -> float | None:
    """Estimate the seconds until the job ends from measured rates and durations; None if one is missing."""
    names = [step.name for step in state.plan]
    if not state.live or state.step not in names:
        return None
    at = names.index(state.step)
    current, later = state.plan[at], state.plan[at + 1 :]
    left = seconds_left(state, now)
    if current.is_measured:
        # the counter may be one of several of this step
        expected = current.seconds - (now - state.step_started)
        left = max(left or 0.0, expected) if expected > 0 else left
    if left is None or not all(step.is_measured for step in later):
        return None
    return left + sum(step.seconds for step in later)


def write_state(folder: Path, state: JobState) -> None:
    """Replace the state file atomically."""
    with atomic_write(folder / _STATE_FILE) as stream:
        stream.write((json.dumps(asdict(state)) + "\n").encode())


class Jobs:
    """The jobs of a folder, at most one at a time, also across processes."""

    def __init__(self, folder: Path) -> None:
        """Attach to the job that runs in `folder`, if any."""
        self.folder = folder
        self._child: subprocess.Popen[bytes] | None = None

    def start(self, command: Sequence[str], *, title: str, shown: Sequence[str]) -> None:
        """Start a job, and wait until its process has written its first state.

        `command` must call `acquire_job_lock` first; `shown` are the arguments of the equivalent `splatgraft` command.
        Raise ValueError if a job is running already.
        """
        state = self.state()
        if state is not None and state.live:
            raise ValueError(f"{state.title}: expected no other job, found this one running; wait or cancel it")
        with writable(self.folder / _LOG_FILE):
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / _STATE_FILE).unlink(missing_ok=True)
        with (self.folder / _LOG_FILE).open("wb") as log:
            self._child = subprocess.Popen(
                list(command), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        while self._read() is None and self._child.poll() is None:
            time.sleep(_WAIT)
        if self._read() is None:
            write_state(self.folder, JobState(title, tuple(shown), self._child.pid, "killed", time.time()))

    def state(self) -> JobState | None:
        """Return the state of the running or the last job; None if no job was started."""
        if self._child is not None:
            self._child.poll()
        state = self._read()
        # the process holds the lock while it is alive
        if state is None or not state.live or _is_locked(self.folder / _LOCK_FILE):
            return state
        state = self._read() or state
        return replace(state, outcome="killed") if state.live else state

    def cancel(self) -> None:
        """Interrupt the process group of the running job; earlier results stay complete."""
        state = self.state()
        if state is not None and state.live:
            if hasattr(os, "killpg"):
                os.killpg(state.pid, signal.SIGINT)
            else:
                os.kill(state.pid, signal.SIGTERM)

    def _read(self) -> JobState | None:
        try:
            found = json.loads((self.folder / _STATE_FILE).read_text(encoding="utf-8"))
            found["plan"] = tuple(PlannedStep(**step) for step in found["plan"])
            state = JobState(**found | {name: tuple(found[name]) for name in ("command", "said")})
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None  # missing, or of another version
        # a process is signalled by this number: 0 and below would be a group, or all processes
        return state if state.pid > 1 else None


def acquire_job_lock(folder: Path) -> filelock.BaseFileLock:
    """Lock the job folder until the process ends; raise ValueError if another job holds the lock."""
    lock = filelock.FileLock(folder / _LOCK_FILE)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        raise ValueError(f"{folder}: expected no other job running here, found one") from error
    return lock


def _is_locked(path: Path) -> bool:
    try:
        with filelock.FileLock(path).acquire(timeout=0):
            return False
    except filelock.Timeout:
        return True
