"""The child process of the editor's jobs: the command `run`, with its progress written to a state file.

Started as `python -m splatgraft.workflow.background_job FOLDER TITLE project.toml STEP [OUT]`; not a command.
"""

import os
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from splatgraft.editor.jobs.jobs import JobState, PlannedStep, acquire_job_lock, write_state
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress

_WRITE_EVERY = 0.2
"""Seconds between writes of the state file."""


class JobConsole(Console):
    """A console whose progress bars are also written to the state file of a job."""

    def __init__(self, folder: Path, state: JobState) -> None:
        """Start from `state`; nothing is written yet."""
        super().__init__()
        self._folder, self.state = folder, state
        self._written = 0.0

    @contextmanager
    def bar(self, name: str) -> Generator[Progress]:
        """A progress bar of `Console` that also updates the state file."""
        now = time.time()
        self.write(replace(self.state, step=name, done=0, total=0, message="", step_started=now))
        last: tuple[int, int] | None = None
        with super().bar(name) as progress:

            def move(done: int, total: int, message: str) -> None:
                nonlocal last
                progress(done, total, message)
                if last is None or done < last[0] or total != last[1]:
                    # a new counter; units that an earlier, killed run finished do not count for the speed
                    began = now if last is None else time.time()
                    self.state = replace(self.state, begun=done if done > 1 else 0, begun_at=began)
                last = (done, total)
                self.state = replace(self.state, done=done, total=total, message=f"{done}/{total} {message}")
                if time.time() - self._written > _WRITE_EVERY:
                    self.write(self.state)

            yield move

    def write(self, state: JobState) -> None:
        """Replace the state file."""
        self.state, self._written = state, time.time()
        write_state(self._folder, state)


def run_as_job(folder: Path, title: str, shown: Sequence[str], work: Callable[[JobConsole], Sequence[str]]) -> int:
    """Do the work of a job's process; progress, outcome and error go into the state file.

    Args:
        folder: Of the state file; another job there is refused.
        title: Title for the user.
        shown: Arguments of the equivalent `splatgraft` command.
        work: Called once; gives sentences for the user on what was done. It imports what it needs, so that an
            interruption while torch is loaded is an outcome too.

    Returns:
        The exit status.

    Raises:
        ValueError: If another job holds the folder's lock.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # a shell starts background processes with SIGINT ignored
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    lock = acquire_job_lock(folder)
    console = JobConsole(folder, JobState(title, tuple(shown), os.getpid(), "running", time.time()))
    try:
        console.write(console.state)
        said = tuple(work(console))
        console.write(replace(console.state, outcome="done", said=said))
        return 0
    except KeyboardInterrupt:
        console.write(replace(console.state, outcome="cancelled"))
        return 130
    except (ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
        console.write(replace(console.state, outcome="failed", error=" ".join(str(error).split())))
        return 2
    finally:
        lock.release()


def main(arguments: Sequence[str]) -> int:
    """Run the steps; the outcome is in the state file and the exit status."""
    folder, title, project, to = Path(arguments[0]), arguments[1], Path(arguments[2]), arguments[3]
    out = Path(arguments[4]) if len(arguments) > 4 else None

    def work(console: JobConsole) -> Sequence[str]:
        from splatgraft.workflow.run import run_steps

        console.write(replace(console.state, plan=_plan(project, out, to)))
        run_steps(project, console, out=out, to=to)
        return ()

    return run_as_job(folder, title, ("run", str(project), "--to", to), work)


def _plan(project: Path, out: Path | None, to: str) -> tuple[PlannedStep, ...]:
    """The steps to be run with their expected durations; empty where the project is invalid."""
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
