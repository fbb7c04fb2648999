"""Jobs: child processes that outlive the page and the server and report progress in a state file.

A lock file shows whether the process of a job is alive. The process executes `run` or `export`; it is started as
`python -m splatgraft.editor.jobs FOLDER TITLE COMMAND WORDS...`.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

from splatgraft.project.step import locked
from splatgraft.project.step_table import PlannedStep
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write, os_error_line, writable
from splatgraft.runtime.progress import Progress

T = TypeVar("T")
_STATE_FILE, _LOG_FILE, _LOCK = "job.json", "job.log", "job"
_PROGRAM = (sys.executable, "-m", "splatgraft.editor.jobs")
Outcome = Literal["running", "done", "failed", "cancelled", "killed"]
_WAIT = 0.02  # seconds between reads of the state file while a job starts
_WRITE_EVERY = 0.2  # seconds between writes of the state file
_MIN_SPENT = 2.0  # seconds after which a counter's rate is known


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

    def start(self, words: Sequence[str], title: str) -> None:
        """Start a job with the arguments of `splatgraft`, and wait until its process has written its first state.

        Raise ValueError if a job is running already.
        """
        state = self.state()
        if state is not None and state.live:
            raise ValueError(f"{state.title}: expected no other job, found this one running; wait or cancel it")
        with writable(self.folder / _LOG_FILE):
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / _STATE_FILE).unlink(missing_ok=True)
        command = [*_PROGRAM, str(self.folder), title, *words]
        with (self.folder / _LOG_FILE).open("wb") as log:
            self._child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        while self._read() is None and self._child.poll() is None:
            time.sleep(_WAIT)
        if self._read() is None:
            write_state(self.folder, JobState(title, tuple(words), self._child.pid, "killed"))

    def state(self) -> JobState | None:
        """Return the state of the running or the last job; None if no job was started."""
        if self._child is not None:
            self._child.poll()
        state = self._read()
        if state is None or not state.live or self._is_locked():
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

    def _is_locked(self) -> bool:
        """Return whether a process holds the lock, as that of a job does while it is alive."""
        try:
            with locked(self.folder / _LOCK):
                return False
        except ValueError:
            return True


# the process of a job


class JobConsole(Console):
    """A console whose progress bars are also written to the state file of a job."""

    def __init__(self, folder: Path, state: JobState) -> None:
        """Start from `state` without writing it."""
        super().__init__()
        self._folder, self.state, self._written = folder, state, 0.0

    @contextmanager
    def bar(self, name: str) -> Generator[Progress]:
        """Show the progress bar of `Console` and update the state file."""
        now = time.time()
        begun = {"done": 0, "total": 0, "message": "", "begun": 0}
        self.write(replace(self.state, step=name, step_started=now, begun_at=now, **begun))
        with super().bar(name) as progress:

            def move(done: int, total: int, message: str) -> None:
                progress(done, total, message)
                if done < self.state.done or total != self.state.total:
                    # a new counter; units that an earlier, killed run finished do not count for the speed
                    began = time.time() if self.state.total else now
                    self.state = replace(self.state, begun=done if done > 1 else 0, begun_at=began)
                self.state = replace(self.state, done=done, total=total, message=f"{done}/{total} {message}")
                if time.time() - self._written > _WRITE_EVERY:
                    self.write(self.state)

            yield move

    def write(self, state: JobState) -> None:
        """Replace the state file."""
        self.state, self._written = state, time.time()
        write_state(self._folder, state)


def main(arguments: Sequence[str]) -> int:
    """Run the command, write progress, outcome and error to the state file, and return the exit status."""
    folder, title, words = Path(arguments[0]), arguments[1], tuple(arguments[2:])
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # a shell starts background processes with SIGINT ignored
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    console = JobConsole(folder, JobState(title, words, os.getpid(), "running"))
    with locked(folder / _LOCK):
        try:
            console.write(console.state)
            said = (_export if words[0] == "export" else _run)(words[1:], console)
            console.write(replace(console.state, outcome="done", said=said))
            return 0
        except KeyboardInterrupt:
            console.write(replace(console.state, outcome="cancelled"))
            return 130
        except (ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
            line = os_error_line(error) if isinstance(error, OSError) else " ".join(str(error).split())
            console.write(replace(console.state, outcome="failed", error=line))
            return 2


# imports are local, so that an interruption while torch loads is recorded as an outcome


def _run(words: Sequence[str], console: JobConsole) -> tuple[str, ...]:
    from splatgraft.commands.run import Run

    command = _parsed(Run, words)
    assert command.to is not None
    console.write(replace(console.state, plan=_plan(command.project, command.out, command.to)))
    command.execute(console)
    return ()


def _export(words: Sequence[str], console: JobConsole) -> tuple[str, ...]:
    from splatgraft.commands.export import Export

    return _parsed(Export, words).write(console)


def _parsed(command: type[T], words: Sequence[str]) -> T:
    import tyro

    return tyro.cli(command, args=words, config=(tyro.conf.OmitArgPrefixes,))


def _plan(project: Path, out: Path | None, to: str) -> tuple[PlannedStep, ...]:
    """List the steps to run with their expected durations; empty if the project is invalid."""
    from splatgraft.workflow.flow import read_flow, reasons
    from splatgraft.workflow.time_estimate import estimate_step_times

    try:
        flow = read_flow(project, out)
        why = reasons(flow, flow.up_to(to))
        return estimate_step_times(flow, [name for name, reason in why.items() if reason is not None])
    except ValueError:
        return ()  # the run itself reports the error


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
