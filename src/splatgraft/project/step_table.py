"""The table of steps: command, result folder, default inputs and typical time of each.

A new step is a file in `steps/` and a row here. The command line, the flow, project.toml with its reference, and
the time estimates read this table. It loads a step's module only on demand, because that imports torch.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from splatgraft.project.layout import (
    CAMERAS_FILE,
    IS_OBJECT_FILE,
    LIGHT_TEXT_FILE,
    OBJECT_FILE,
    PLACEMENT_FILE,
    SCENE_FILE,
    SIDES,
    SURROUNDINGS_FILE,
    Layout,
)

_AT = Layout(Path())
_SOURCE_CAMERAS, _CAMERAS = (_AT.capture(side) / CAMERAS_FILE for side in SIDES)
_TARGET = _AT.scene("target") / SCENE_FILE
_COMPOSITE, _RELIT = _AT.composite / SCENE_FILE, _AT.relit / SCENE_FILE
_OBJECT, _SURROUNDINGS = _AT.object / OBJECT_FILE, _AT.object / SURROUNDINGS_FILE


@dataclass(frozen=True)
class PlannedStep:
    """A step that a run will perform."""

    name: str
    """Name of the step."""
    seconds: float
    """Expected duration."""
    is_measured: bool
    """Whether `seconds` is the duration of an earlier run of this step, rather than a default."""


@dataclass(frozen=True)
class StepRow:
    """One step of a project."""

    command: str
    """Name of the command, of the module in `splatgraft.steps` and of the table in project.toml."""
    summary: str
    """Summary in the list of commands."""
    folder: Path
    """Folder of the result, relative to the project's root, or to source/ and target/ if `per_capture`."""
    seconds: float
    """Time in a first `splatgraft demo` on two cores, including compilation of the kernels."""
    inputs: Mapping[str, Path] = field(default_factory=dict)
    """Default paths by field of the step's class, relative to the project's root."""
    per_capture: bool = False
    """Whether the step is done for source and target; `workflow/flow.py` then gives the inputs."""
    has_table: bool = True
    """Whether project.toml may have a table for the step."""

    def load(self) -> type[Any]:
        """Import the step's module and return its class."""
        return import_module(f"splatgraft.steps.{self.command}").COMMAND


STEPS = (
    StepRow(
        "capture",
        "pose photos or a video, take over poses, or look at a scene from all around",
        folder=Path("capture"),
        seconds=1.0,
        per_capture=True,
    ),
    StepRow(
        "adopt",
        "take over a scene that was trained elsewhere",
        folder=Path("scene"),
        seconds=0.2,
        per_capture=True,
        has_table=False,
    ),
    StepRow("reconstruct", "train a 3DGS scene on posed images", folder=Path("scene"), seconds=56.0, per_capture=True),
    StepRow(
        "segment",
        "lift 2D masks to the Gaussians of the object",
        folder=_AT.object,
        seconds=5.0,
        inputs={"scene": _AT.scene("source") / SCENE_FILE, "capture": _AT.capture("source")},
    ),
    StepRow(
        "compose",
        "place the object in the target scene",
        folder=_AT.composite,
        seconds=0.2,
        inputs={
            "target": _TARGET,
            "object": _OBJECT,
            "surroundings": _SURROUNDINGS,
            "cameras": _CAMERAS,
            "object_cameras": _SOURCE_CAMERAS,
        },
    ),
    StepRow(
        "relight",
        "give the object the light of its new place",
        folder=_AT.relit,
        seconds=15.0,
        inputs={
            "target": _TARGET,
            "placement": _AT.composite / PLACEMENT_FILE,
            "cameras": _CAMERAS,
            "surroundings": _SURROUNDINGS,
            "object_cameras": _SOURCE_CAMERAS,
            "taken": _OBJECT,
        },
    ),
    StepRow(
        "render",
        "render a scene or a composite from given cameras",
        folder=_AT.views,
        seconds=1.0,
        inputs={
            "scene": _COMPOSITE,
            "cameras": _CAMERAS,
            "is_object": _AT.composite / IS_OBJECT_FILE,
            "prior": _RELIT,
        },
    ),
    StepRow(
        "harmonize",
        "make the light of each rendered view agree",
        folder=_AT.harmonized,
        seconds=1.1,
        inputs={"views": _AT.views},
    ),
    StepRow(
        "consolidate",
        "fit the colours of the scene to the harmonised views",
        folder=_AT.result,
        seconds=2.0,
        inputs={"scene": _RELIT, "views": _AT.views, "images": _AT.harmonized},
    ),
    StepRow(
        "evaluate",
        "compare, picture and report",
        folder=_AT.report,
        seconds=3.0,
        inputs={
            "result": _AT.result / SCENE_FILE,
            "composite": _AT.composite,
            "cameras": _CAMERAS,
            "target_capture": _AT.capture("target"),
            "views": _AT.views,
            "light": _AT.relit / LIGHT_TEXT_FILE,
            "project": _AT.root,
        },
    ),
)
"""All steps in the order of the flow."""

RESULTS_IN_ORDER = (
    *dict.fromkeys(f"{side}/{row.folder}" for side in SIDES for row in STEPS if row.per_capture),
    *(str(row.folder) for row in STEPS if not row.per_capture),
)
"""All result folders of a project, relative to its root, in the order of their making."""
