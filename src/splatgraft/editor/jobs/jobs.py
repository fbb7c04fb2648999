"""Long work in a child process of its own session: it outlives the page and the server, and tells how far it is.

Knows nothing about what is done: a command line is started, a state file is read.
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

from splatgraft.runtime.atomic_file import atomic_write

STATE_FILE, LOG_FILE, LOCK_FILE = "job.json", "job.log", "job.lock"
Outcome = Literal["starting", "running", "done", "failed", "cancelled", "killed"]
_LIVE = ("starting", "running")


@dataclass(frozen=True)
class PlannedStep:
    """A step that a job will do or has done."""

    name: str
    """As the state names it."""
    seconds: float
    """What it will roughly take."""
    is_measured: bool
    """Whether that is how long it took here before, rather than what is usual."""


@dataclass(frozen=True)
class JobState:
    """How far a job is, as its process wrote it last."""

    title: str
    """What a person asked for."""
    command: tuple[str, ...]
    """The words a person would type after `splatgraft`."""
    pid: int
    """Of the process, which leads its own group."""
    outcome: Outcome
    """killed: it ended without a word, as by a power cut; the same command goes on from there."""
    started: float
    """Seconds since 1970."""
    step: str = ""
    """The step at work."""
    done: int = 0
    """Of the step's own units."""
    total: int = 0
    """Of the same; 0 where not known yet."""
    message: str = ""
    """What the step says about itself."""
    step_started: float = 0.0
    """Seconds since 1970."""
    begun: int = 0
    """Units that were done when it began to count: by an earlier run that was killed."""
    begun_at: float = 0.0
    """Seconds since 1970: when it began to count; a step that counts several things begins several times."""
    error: str = ""
    """One line where it failed."""
    plan: tuple[PlannedStep, ...] = ()
    """All steps of the job in their order; empty where that is not known."""
    took: tuple[tuple[str, float], ...] = ()
    """Steps of this run that have ended, with their seconds."""

    @property
    def live(self) -> bool:
        """Whether it is still at work."""
        return self.outcome in _LIVE

    @property
    def share(self) -> float:
        """Of the step at work, in [0, 1]."""
        return min(1.0, self.done / self.total) if self.total else 0.0


def seconds_left(state: JobState, now: float) -> float | None:
    """Until what the step counts is done, if it goes on as it has; None at its end, and where it is too early."""
    spent, done = now - state.begun_at, state.done - state.begun
    if not state.live or not 0 < done < state.total - state.begun or spent < 1:
        return None
    return spent * (state.total - state.done) / done


def seconds_left_in_all(state: JobState, now: float) -> float | None:
    """Until the whole job ends; None where it is too early to tell.

    The steps to come take what they took before; guesses among them are corrected by how far off the steps of this
    run were, the one at work as far as its progress tells.
    """
    names = [step.name for step in state.plan]
    if not state.live or state.step not in names:
        return None
    at = names.index(state.step)
    current, later = state.plan[at], state.plan[at + 1 :]
    left, spent = seconds_left(state, now), now - state.step_started
    if left is None and not current.is_measured and at == 0:
        return None
    factor = _slowness(state, None if left is None else spent + left)
    expected = current.seconds * (1.0 if current.is_measured else factor) - spent
    # what it counts now may be one of several things
    left = max(left or 0.0, expected if left is None or current.is_measured else 0.0)
    return left + sum(step.seconds * (1.0 if step.is_measured else factor) for step in later)


def _slowness(state: JobState, current: float | None) -> float:
    """How many times what was guessed the steps of this run take; 1 where nothing is known."""
    took = dict(state.took) | ({} if current is None else {state.step: current})
    guessed = {step.name: step.seconds for step in state.plan if not step.is_measured and step.name in took}
    whole = sum(guessed.values())
    return sum(took[name] for name in guessed) / whole if whole > 0 else 1.0


def write_state(folder: Path, state: JobState) -> None:
    """Replace the state file, whole or not at all."""
    with atomic_write(folder / STATE_FILE) as stream:
        stream.write((json.dumps(asdict(state)) + "\n").encode())


class Jobs:
    """At most one job at a time in one folder, whoever started it."""

    def __init__(self, folder: Path) -> None:
        """Take up what runs in `folder` or was left there."""
        self.folder = folder
        self._child: subprocess.Popen[bytes] | None = None

    def start(self, command: Sequence[str], *, title: str, shown: Sequence[str]) -> None:
        """Run `command`, whose process must call `hold`; `shown` is what a person would type.

        Raises: ValueError where one is at work already.
        """
        state = self.state()
        if state is not None and state.live:
            raise ValueError(f"{state.title}: expected it to be over, found it at work; wait or cancel")
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / LOG_FILE).open("wb") as log:
            self._child = subprocess.Popen(
                list(command), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        first = JobState(title, tuple(shown), self._child.pid, "starting", time.time())
        # the child may have written already; its word is newer
        if not (found := self._read()) or found.pid != self._child.pid:
            write_state(self.folder, first)

    def state(self) -> JobState | None:
        """The job at work or the last one; None where there never was one."""
        if self._child is not None:
            self._child.poll()
        state = self._read()
        if state is None or not state.live:
            return state
        # a process that only just began has not locked yet; one that locked is alive as long as the lock is held
        at_work = _held(self.folder / LOCK_FILE) if state.outcome == "running" else self._is_alive(state.pid)
        if at_work:
            return state
        state = self._read() or state
        return replace(state, outcome="killed") if state.live else state

    def cancel(self) -> None:
        """Ask the process and all that it started to stop; earlier results stay whole."""
        state = self.state()
        if state is not None and state.live:
            if hasattr(os, "killpg"):
                os.killpg(state.pid, signal.SIGINT)
            else:
                os.kill(state.pid, signal.SIGTERM)

    def log_tail(self, lines: int = 12) -> str:
        """The end of what it said."""
        path = self.folder / LOG_FILE
        return "\n".join(path.read_text(errors="replace").splitlines()[-lines:]) if path.is_file() else ""

    def _read(self) -> JobState | None:
        try:
            fields = json.loads((self.folder / STATE_FILE).read_text())
            plan = tuple(PlannedStep(**step) for step in fields.pop("plan", ()))
            took = tuple((str(name), float(seconds)) for name, seconds in fields.pop("took", ()))
            return JobState(**(fields | {"command": tuple(fields["command"]), "plan": plan, "took": took}))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{self.folder / STATE_FILE}: expected the state of a job, found {error}") from error

    def _is_alive(self, pid: int) -> bool:
        if self._child is not None and self._child.pid == pid:
            return self._child.poll() is None
        try:
            os.kill(pid, 0)
        except OSError:
            return False
        return True


def hold(folder: Path) -> filelock.BaseFileLock:
    """The lock by which others know that a job's process is alive; the system lets go of it when that ends.

    Raises: ValueError where another job holds it.
    """
    lock = filelock.FileLock(folder / LOCK_FILE)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        raise ValueError(f"{folder}: expected no other job at work here, found one") from error
    return lock


def _held(path: Path) -> bool:
    try:
        with filelock.FileLock(path).acquire(timeout=0):
            return False
    except filelock.Timeout:
        return True
