"""The steps of a project as a graph: the folders that each step reads, and the stale steps."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatgraft.commands.steps.adopt import Adopt
from splatgraft.commands.steps.capture import Capture
from splatgraft.commands.steps.compose import Compose
from splatgraft.commands.steps.consolidate import Consolidate
from splatgraft.commands.steps.evaluate import Evaluate
from splatgraft.commands.steps.harmonize import Harmonize
from splatgraft.commands.steps.reconstruct import Reconstruct
from splatgraft.commands.steps.relight import Relight
from splatgraft.commands.steps.render import Render
from splatgraft.commands.steps.segment import Segment
from splatgraft.project.layout import (
    CAMERAS_FILE,
    IS_OBJECT_FILE,
    LIGHT_FILE,
    LIGHT_TEXT_FILE,
    OBJECT_FILE,
    PLACEMENT_FILE,
    PROJECT_FILE,
    SCENE_FILE,
    SURROUNDINGS_FILE,
    Layout,
    Side,
)
from splatgraft.project.project_file import ProjectFile, read_project_file
from splatgraft.project.record import why_stale
from splatgraft.project.step import Step, job_of, path_fields

STEPS = (Capture, Reconstruct, Segment, Compose, Relight, Render, Harmonize, Consolidate, Evaluate)


@dataclass(frozen=True)
class Flow:
    """All steps of a project, each after those it reads from."""

    layout: Layout
    """Folders of the results."""
    steps: Mapping[str, Step]
    """Steps by name: the command, after source/ or target/ if both captures need it."""

    def __iter__(self) -> Iterator[tuple[str, Step]]:
        return iter(self.steps.items())

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
        """Return the steps that `name` depends on, and itself last; all steps if it is None."""
        wanted = set(self.steps) if name is None else self.named(name)
        for other in reversed(list(self.steps)):
            wanted |= set(self.before(other)) if other in wanted else set()
        return {other: step for other, step in self if other in wanted}


def read_flow(project: Path, out: Path | None = None) -> Flow:
    """Read the steps of a project, its file or folder; `out` is the root of the results, by default its folder.

    Raises: ValueError if the file is missing, or one of its keys or values is not as expected.
    """
    path = project / PROJECT_FILE if project.is_dir() else project
    file = read_project_file(path, tables=tuple(kind.__name__.lower() for kind in STEPS))
    layout = Layout(path.parent if out is None else out)
    sides: tuple[Side, ...] = ("source", "target")
    steps: dict[str, Step] = {}
    for side in sides:
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
    given = default_paths(layout)
    if placement.is_file():
        given[Compose] = given[Compose] | {"placement": placement}
    folders = (layout.object, layout.composite, layout.relit, layout.views)
    folders += (layout.harmonized, layout.result, layout.report)
    plan = zip(given.items(), folders, strict=True)
    return {kind.__name__.lower(): file.step(kind, paths, out=out) for (kind, paths), out in plan}


def default_paths(layout: Layout) -> dict[type[Any], dict[str, Path]]:
    """Return the input paths that a project gives to each step after the reconstructions, in the order of the flow."""
    source, target = (layout.scene(side) / SCENE_FILE for side in ("source", "target"))
    source_capture, target_capture = layout.capture("source"), layout.capture("target")
    cameras, source_cameras = (layout.capture(side) / CAMERAS_FILE for side in ("target", "source"))
    surroundings = layout.object / SURROUNDINGS_FILE
    composite, relit = layout.composite / SCENE_FILE, layout.relit / SCENE_FILE

    segment = {"scene": source, "capture": source_capture}
    compose = {"target": target, "object": layout.object / OBJECT_FILE, "surroundings": surroundings}
    compose |= {"cameras": cameras, "object_cameras": source_cameras}
    relight = {"target": target, "placement": layout.composite / PLACEMENT_FILE, "cameras": cameras}
    relight |= {"surroundings": surroundings, "object_cameras": source_cameras, "taken": layout.object / OBJECT_FILE}
    render = {"scene": composite, "cameras": cameras, "is_object": layout.composite / IS_OBJECT_FILE}
    render |= {"prior": relit, "light": layout.relit / LIGHT_FILE}
    consolidate = {"scene": relit, "views": layout.views, "images": layout.harmonized}
    evaluate = {"result": layout.result / SCENE_FILE, "composite": layout.composite, "cameras": cameras}
    evaluate |= {"target_capture": target_capture, "views": layout.views, "light": layout.relit / LIGHT_TEXT_FILE}
    evaluate |= {"project": layout.root}
    return {
        Segment: segment,
        Compose: compose,
        Relight: relight,
        Render: render,
        Harmonize: {"views": layout.views},
        Consolidate: consolidate,
        Evaluate: evaluate,
    }


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
