"""Run a project and read its state, for the commands `run` and `status` and for Python."""

import os
import subprocess
import sys
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from splatgraft.project.layout import REPORT_FILE, SCENE_FILE
from splatgraft.project.record import why_stale
from splatgraft.project.step import clear_leftovers, job_of, locked, perform
from splatgraft.project.step_table import PlannedStep
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import is_writable
from splatgraft.steps.capture import Capture, doubt_about
from splatgraft.workflow.flow import Flow, read_flow, reasons
from splatgraft.workflow.time_estimate import describe_estimate, estimate_step_times

_WORTHWHILE_SECONDS = 20.0  # expected time of a capture from which a process of its own is worth its start
_PERFORM_ALONE = "import sys; from splatgraft.workflow.run import perform_alone; perform_alone(*sys.argv[1:])"


def run_steps(
    project: Path,
    console: Console,
    *,
    out: Path | None = None,
    to: str | None = None,
    force: tuple[str, ...] = (),
    accept_doubtful: bool = False,
) -> None:
    """Perform the stale steps up to `to`, and the steps in `force`, and print the paths of the results.

    Raises: ValueError if the project file or an input is bad, another run works on the project, or the poses of a
    capture are not plausible and this was not accepted.
    """
    flow = read_flow(project, out)
    wanted = flow.up_to(to)
    forced = {step for name in force for step in flow.named(name)}
    root = flow.layout.root
    # a read-only project needs no lock; if a step is stale there, the step raises an error about its folder
    with locked(root / "project") if is_writable(root) else nullcontext():
        why = reasons(flow, wanted)
        planned = estimate_step_times(flow, [name for name in wanted if name in forced or why[name] is not None])
        if planned:
            console.say(describe_estimate(planned))
        with _captures_ahead(flow, project, out, planned) as begun:
            for name, step in wanted.items():
                reason = "asked for" if name in forced else why_stale(job_of(step))
                console.say(f"{name:<20} {reason or 'up to date'}")
                if name in begun:
                    _finish(begun[name], console)
                    reason = why_stale(job_of(step))
                if reason:
                    perform(step, console, name=name)
                elif is_writable(step.out.parent):
                    clear_leftovers(step.out)
                if isinstance(step, Capture) and not accept_doubtful and (doubt := doubt_about(step)):
                    raise ValueError(doubt)
    console.say("results:")
    layout = flow.layout
    for name, path in (("consolidate", layout.result / SCENE_FILE), ("evaluate", layout.report / REPORT_FILE)):
        if name in wanted:
            console.result(path)


@contextmanager
def _captures_ahead(
    flow: Flow, project: Path, out: Path | None, planned: Sequence[PlannedStep]
) -> Generator[dict[str, subprocess.Popen[str]]]:
    """Begin all planned captures but the first, each in a process; at the end, those still running are stopped.

    Half of structure from motion runs on one core (mapping and refinement), so two captures at once take little longer
    than one. Short captures are not begun. A later run continues a capture that was stopped.

    Yields:
        The processes by the name of their step.
    """
    long = [
        one.name for one in planned if isinstance(flow.steps[one.name], Capture) and one.seconds > _WORTHWHILE_SECONDS
    ]
    begun: dict[str, subprocess.Popen[str]] = {}
    try:
        for name in long[1:]:
            command = [sys.executable, "-c", _PERFORM_ALONE, str(project), "" if out is None else str(out), name]
            pipe = subprocess.PIPE
            begun[name] = subprocess.Popen(
                command, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe, encoding="locale", errors="replace"
            )
        yield begun
    finally:
        for process in begun.values():
            process.terminate()
            process.communicate()


def _finish(process: subprocess.Popen[str], console: Console) -> None:
    """Print the messages of a process until it ends; a failure is left to the step's own error."""
    assert process.stderr is not None
    for line in process.stderr:
        console.say(line.rstrip())
    process.wait()


def perform_alone(project: str, out: str, name: str) -> None:
    """Perform one step of a project in this process, which ends when the process that began it ends.

    Args:
        project: The project file, or its folder.
        out: Root of the results; empty for the project's folder.
        name: The step.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    perform(read_flow(Path(project), Path(out) if out else None).steps[name], Console(), name=name)


def _end_with_parent() -> None:
    # standard input closes with the parent; sys.stdin has a lock that a thread may hold at the exit
    while os.read(0, 1):
        pass
    os._exit(1)


def run_project(
    project: Path | str, *, out: Path | str | None = None, to: str | None = None, force: tuple[str, ...] = ()
) -> dict[str, Path]:
    """Perform the stale steps of a project, as the command `run` does; progress goes to standard error.

    Args:
        project: The project file, as `splatgraft init` writes it, or its folder.
        out: Root of the results; the project's folder if not given.
        to: The last step wanted, such as "relight", "reconstruct" (both captures) or "source/reconstruct"; all steps
            if not given.
        force: Steps that are performed even if they are up to date.

    Returns:
        The result folder of every wanted step, by step, in the order of the flow.

    Raises:
        ValueError: The project file or an input is bad, or another run works on the project.
    """
    root = None if out is None else Path(out)
    run_steps(Path(project), Console(), out=root, to=to, force=force)
    return {name: step.out for name, step in read_flow(Path(project), root).up_to(to).items()}


def stale_steps(project: Path | str, *, out: Path | str | None = None) -> dict[str, str]:
    """Return the steps of a project whose results are not up to date.

    Args:
        project: The project file, or its folder.
        out: Root of the results; the project's folder if not given.

    Returns:
        The reason why each stale step is stale, by step, in the order of the flow.

    Raises:
        ValueError: The project file or an input is bad.
    """
    flow = read_flow(Path(project), None if out is None else Path(out))
    return {name: reason for name, reason in reasons(flow).items() if reason is not None}
