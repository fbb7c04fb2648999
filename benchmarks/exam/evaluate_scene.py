"""One scene of an exam measured: all rows on its held-out views, the light's errors, and a picture beside the truth."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from exam.measure_light import light_errors, median_angle_deg
from exam.rows import make_row
from exam.scene_files import ExamScene, TrueView
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_image
from splatgraft.relighting import Relit
from splatgraft_paper.benchmark.view_metrics import measure_view

LIGHT_ROW = "transfer"
"""The row whose estimates of light and normals are measured."""
METRICS = {"object": "psnr_object", "whole": "psnr_whole", "shadow": "shadow_ratio_rmse"}
"""Of a row, and the names that `measure_view` gives them: PSNR in dB twice, and the error of the shadow's strength."""
_PICTURED = ("paste", "transfer", "told-both-and-normals")
_OPAQUE = 0.3
"""Opacity above which the normal of a Gaussian is measured."""


@dataclass(frozen=True)
class SceneResult:
    """What was measured on one scene; a value is None where it is not defined."""

    name: str
    rows: dict[str, dict[str, float | None]] = field(default_factory=dict)
    """Per row the values of `METRICS`, means over held-out views."""
    light: dict[str, dict[str, float] | None] = field(default_factory=dict)
    """`light_errors` at the new and the old place; None where no light was found."""
    normals_deg: float | None = None
    """Median angle between estimated and true normals of the object."""
    notes: tuple[str, ...] = ()
    """Why a row or a value is missing; what the transfer reports."""

    @property
    def ratio_level(self) -> float | None:
        """Error of the level of the ratio of new to old light, stops."""
        new, old = self.light.get("new"), self.light.get("old")
        return None if new is None or old is None else new["level"] - old["level"]

    def as_json(self) -> dict:
        """Plain data, from which `from_json` makes the same value."""
        return asdict(self)

    @staticmethod
    def from_json(record: dict) -> "SceneResult":
        """Read what `as_json` gave."""
        return SceneResult(**{**record, "notes": tuple(record["notes"])})


def evaluate_scene(scene: ExamScene, rows: Sequence[str], picture: Path) -> SceneResult:
    """Make and measure the rows of a scene.

    Args:
        scene: The scene.
        rows: Names of `ROWS`.
        picture: A .png to write: held-out views one above the other; pasted, the transfer, the one that is told
            everything, the truth side by side.
    """
    values, columns, notes = {}, [], []
    light, normals_deg = {}, None
    for row in rows:
        try:
            result, relit = make_row(row, scene)
        except ValueError as error:
            notes.append(f"{row}: {error}")
            continue
        values[row] = measure_row(result, scene.views)
        if row in _PICTURED:
            columns.append([view.picture(result) for view in scene.views])
        if row == LIGHT_ROW and relit is not None:
            light, normals_deg = _measure_estimates(scene, relit)
            notes += relit.report
    columns.append([view.truth.image for view in scene.views])
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_image(picture, torch.cat([torch.cat(column, 0) for column in columns], 1))
    return SceneResult(scene.name, values, light, normals_deg, tuple(notes))


def measure_row(result: Gaussians, views: Sequence[TrueView]) -> dict[str, float | None]:
    """The values of `METRICS`, means over the views where they are defined."""
    found = [measure_view(view.picture(result), view.truth, background=view.background) for view in views]
    out: dict[str, float | None] = {}
    for short, name in METRICS.items():
        known = [values[name] for values in found if math.isfinite(values[name])]
        out[short] = sum(known) / len(known) if known else None
    return out


def _measure_estimates(scene: ExamScene, relit: Relit) -> tuple[dict[str, dict[str, float] | None], float | None]:
    """Errors of both lights, and of the normals in degrees, of a transfer to which nothing was told."""
    light = {"new": None if relit.light is None else light_errors(relit.light, scene.new_light), "old": None}
    if not relit.prepared:
        return light, None
    found, rotation = relit.prepared[0], scene.composite.objects[0].target_from_object.rotation
    if found.source_lighting is not None:
        light["old"] = light_errors(found.source_lighting.light, scene.old_light.rotated(rotation))
    if scene.normals is None:
        return light, None
    opaque_and_seen = (found.gaussians.opacities > _OPAQUE) & found.normals.seen
    return light, median_angle_deg(found.normals.vectors, scene.normals @ rotation.T, opaque_and_seen)
