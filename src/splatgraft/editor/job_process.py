"""The child process of a job, which executes `run` or `export` and writes its progress to a state file.

`Jobs` starts it as `python -m splatgraft.editor.job_process FOLDER TITLE COMMAND WORDS...`.
"""

import os
import signal
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from splatgraft.editor.jobs import JobState, acquire_job_lock, write_state
from splatgraft.project.step_table import PlannedStep
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import os_error_line
from splatgraft.runtime.progress import Progress

T = TypeVar("T")
_WRITE_EVERY = 0.2
"""Seconds between writes of the state file."""


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


def main(arguments: Sequence[str]) -> int:
    """Run the command, write progress, outcome and error to the state file, and return the exit status."""
    folder, title, words = Path(arguments[0]), arguments[1], tuple(arguments[2:])
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # a shell starts background processes with SIGINT ignored
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    lock = acquire_job_lock(folder)
    console = JobConsole(folder, JobState(title, words, os.getpid(), "running", time.time()))
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
    finally:
        lock.release()


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
