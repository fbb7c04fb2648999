"""The steps of a project as a graph: the folders that each step reads, and the stale steps."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from splatgraft.project.layout import PLACEMENT_FILE, PROJECT_FILE, SIDES, Layout
from splatgraft.project.project_file import ProjectFile, read_project_file
from splatgraft.project.record import why_stale
from splatgraft.project.step import Step, job_of, path_fields
from splatgraft.project.step_table import STEPS
from splatgraft.steps.adopt import Adopt
from splatgraft.steps.capture import Capture
from splatgraft.steps.compose import Compose
from splatgraft.steps.reconstruct import Reconstruct

T = TypeVar("T")


@dataclass(frozen=True)
class Flow:
    """All steps of a project, each after those it reads from."""

    layout: Layout
    """Folders of the results."""
    steps: Mapping[str, Step]
    """Steps by name: the command, after source/ or target/ if both captures need it."""

    def __iter__(self) -> Iterator[tuple[str, Step]]:
        return iter(self.steps.items())

    def typed(self, kind: type[T], name: str = "") -> T:
        """Return the step of a class; `name` says which one if both captures have one."""
        step = self.steps[name or kind.__name__.lower()]
        assert isinstance(step, kind)
        return step

    def before(self, name: str) -> list[str]:
        """Return the steps whose results `name` reads."""
        paths = path_fields(self.steps[name])
        return [other for other, step in self if any(path.is_relative_to(step.out) for path in paths)]

    def named(self, name: str) -> set[str]:
        """Return the steps of that name: reconstruct is both source/reconstruct and target/reconstruct."""
        found = {step for step in self.steps if name in (step, step.split("/")[-1])}
        if not found:
            raise ValueError(f"--to, --force: expected a step among {', '.join(self.steps)}; found {name}")
        return found

    def up_to(self, name: str | None) -> dict[str, Step]:
        """Return the steps that `name` depends on, then `name`; all steps if `name` is None."""
        wanted = set(self.steps) if name is None else self.named(name)
        for other in reversed(list(self.steps)):
            wanted |= set(self.before(other)) if other in wanted else set()
        return {other: step for other, step in self if other in wanted}


def read_flow(project: Path, out: Path | None = None) -> Flow:
    """Read the steps of a project, its file or folder; `out` is the root of the results, by default its folder.

    Raises: ValueError if the file is missing, or one of its keys or values is not as expected.
    """
    path = project / PROJECT_FILE if project.is_dir() else project
    file = read_project_file(path, tables=tuple(row.command for row in STEPS if row.has_table))
    layout = Layout(path.parent if out is None else out)
    steps: dict[str, Step] = {}
    for side in SIDES:
        steps[f"{side}/capture"] = capture = file.step(Capture, out=layout.capture(side), side=side)
        given = {"capture": layout.capture(side)}
        if (trained := file.scene(side)) is None:
            made = file.step(Reconstruct, given, out=layout.scene(side), side=side)
        else:  # a trained scene replaces the reconstruction; by default it has the axes given for its capture
            made = file.step(Adopt, given | {"scene": trained}, out=layout.scene(side), side=side)
            made = replace(made, axes=capture.axes if made.axes is None else made.axes)
        steps[f"{side}/reconstruct"] = made
    flow = Flow(layout, steps | _joint_steps(file, layout))
    _require_order(path, flow)
    return flow


def _require_order(project: Path, flow: Flow) -> None:
    """Raise ValueError if a step reads its own result or that of a later step."""
    names = list(flow.steps)
    for at, name in enumerate(names):
        for other in flow.before(name):
            if names.index(other) >= at:
                folder = flow.steps[other].out
                raise ValueError(
                    f"{project}: expected inputs of {name} elsewhere than in the results of {other}, found {folder}"
                )


def _joint_steps(file: ProjectFile, layout: Layout) -> dict[str, Step]:
    placement = file.path.parent / PLACEMENT_FILE
    steps: dict[str, Step] = {}
    for row in STEPS:
        if not row.per_capture:
            kind, given = row.load(), {name: layout.root / path for name, path in row.inputs.items()}
            if kind is Compose and placement.is_file():
                given["placement"] = placement
            steps[row.command] = file.step(kind, given, out=layout.root / row.folder)
    return steps


def reasons(flow: Flow, wanted: Collection[str] | None = None) -> dict[str, str | None]:
    """Return why each step is stale, None if it is not; a step that reads a stale result waits for it.

    `wanted`: names of the steps to examine, with all steps that they read from; inputs of others may be missing.
    """
    found: dict[str, str | None] = {}
    for name, step in flow:
        if wanted is not None and name not in wanted:
            continue
        waits = [other for other in flow.before(name) if found[other] is not None]
        found[name] = f"waits for {waits[0]}" if waits else why_stale(job_of(step))
    return found
