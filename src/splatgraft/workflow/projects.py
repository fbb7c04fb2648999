"""Running a project and reading its state from Python: what the commands `run` and `status` do, with values back."""

from pathlib import Path

from splatgraft.runtime.console import Console
from splatgraft.workflow.flow import read_flow
from splatgraft.workflow.run_steps import run_steps
from splatgraft.workflow.staleness import reasons


def run_project(
    project: Path | str, *, out: Path | str | None = None, to: str | None = None, force: tuple[str, ...] = ()
) -> dict[str, Path]:
    """Perform the stale steps of a project, as the command `run` does; progress goes to standard error.

    Args:
        project: The project file (docs: `splatgraft init` writes one), or its folder.
        out: Root of the results; the project's folder where not given.
        to: The last step wanted, such as "relight", "reconstruct" (both captures) or "source/reconstruct"; all steps
            where not given.
        force: Steps that are performed even where they are up to date.

    Returns:
        The result folder of every wanted step, by step, in their order.

    Raises:
        ValueError: The project file or an input is bad, or another run works on the project.
    """
    root = None if out is None else Path(out)
    run_steps(Path(project), Console(), out=root, to=to, force=force)
    return {name: step.out for name, step in read_flow(Path(project), root).up_to(to).items()}


def stale_steps(project: Path | str, *, out: Path | str | None = None) -> dict[str, str]:
    """The steps of a project whose results are not up to date.

    Args:
        project: The project file, or its folder.
        out: Root of the results; the project's folder where not given.

    Returns:
        Why each stale step is stale, by step, in their order.

    Raises:
        ValueError: The project file or an input is bad.
    """
    flow = read_flow(Path(project), None if out is None else Path(out))
    return {name: reason for name, reason in reasons(flow).items() if reason is not None}
