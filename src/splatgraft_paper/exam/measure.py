"""Rows of the held-out benchmark of the light transfer, measured on the held-out views of a scene.

Rows are other methods, the transfer with estimates replaced by the truth one after another, and colours fitted to the
truth. Errors of the estimated light (its irradiance without occlusion) and of normals are measured, too.
"""

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.compositing.contact import flatten_contact_layers
from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.clock_sun import ClockSun, SunCandidate
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import linear_from_srgb, srgb_from_linear, write_image
from splatgraft.evaluation.measure import find_regions
from splatgraft.relighting import Light, Relit, SourceScene, relight
from splatgraft_paper.benchmark.gain import relight_by_gain
from splatgraft_paper.benchmark.measure import measure_view
from splatgraft_paper.benchmark.transplat import relight_by_irradiance_ratio
from splatgraft_paper.exam.scenes import ExamScene, TrueView
from splatgraft_paper.peers.deferred_reflection import ReflectiveScene, fit_reflections, insert
from splatgraft_paper.synthesis.places import OUTDOORS

ROWS: Mapping[str, str] = {
    "paste": "the object as it was captured",
    "gain": "one gain per channel, from the light around both places",
    "transplat": "the ratio of irradiances at each normal (TranSplat's diffuse path), both estimated; no shadow",
    "3dgs-dr": "3DGS-DR: the object reflects an environment that is fitted to the target's photos; no shadow",
    "transfer": "the transfer, everything estimated",
    "clock": "the transfer with a simulated clock of the photos: height exact, azimuth off by about 5 degrees",
    "true-new-light": "the transfer with the ground-truth new light",
    "true-lights": "the transfer with both ground-truth lights",
    "true-lights-and-normals": "the transfer with both ground-truth lights and the ground-truth normals",
    "fitted": "no transfer: colours fitted to true pictures of the other views; no recolouring reaches much more",
}


def make_row(row: str, scene: ExamScene) -> tuple[Gaussians | ReflectiveScene, Relit | None]:
    """Make the scene of a row; return the transfer in layers, too, if the row has one."""
    if row == "paste":
        return scene.composite.bake()[0], None
    if row == "gain":
        return relight_by_gain(scene.composite, scene.cameras, sources=[scene.source])[0].bake()[0], None
    if row == "transplat":
        return relight_by_irradiance_ratio(scene.composite, sources=[scene.source])[0].bake()[0], None
    if row == "3dgs-dr":
        return _with_reflections(scene), None
    if row == "fitted":
        return _fitted_to_truth(scene), None
    source, light = _with_truth(row, scene)
    clock = _simulated_clock(scene) if row == "clock" else None
    relit = relight(scene.composite, scene.cameras, sources=[source], light=light, clock=clock)
    return relit.bake()[0], relit


def _simulated_clock(scene: ExamScene) -> ClockSun:
    """Turn the brightest source of the true new light about the vertical, at random by the scene's name.

    The source is also taken where clouds hide the sun. The scenes' vertical is the z axis.

    Raises:
        ValueError: The scene is a room, or has no source above the horizon.
    """
    above = [one for one in scene.new_light.sources if one.direction[2] > 0]
    if not above or scene.name.rpartition("_")[2] not in OUTDOORS:
        raise ValueError("there is no sun")
    x, y, z = max(above, key=lambda one: one.luminance).direction
    angle = math.radians(random.Random(scene.name).gauss(0, _CLOCK_ERROR_DEG))
    turned = (math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y, z)
    candidate = SunCandidate(datetime(2000, 1, 1, tzinfo=UTC), "simulation", math.degrees(math.asin(z)), turned)
    return ClockSun((candidate,), (0.0, 0.0, 1.0), _CLOCK_ERROR_DEG, 0.0, "simulation", None)


def _with_reflections(scene: ExamScene) -> ReflectiveScene:
    """Fit the object's reflections and the target's environment, each to its own capture, and insert the object."""
    composite, placed = scene.composite, scene.composite.objects[0]
    source = fit_reflections(concatenate([scene.source.gaussians, placed.gaussians]), scene.photos["source"])
    is_object = torch.arange(source.gaussians.count) >= scene.source.gaussians.count
    taken = source.select(is_object)
    moved = replace(placed, gaussians=taken.gaussians).in_target()
    target = fit_reflections(composite.target.select(~composite.erased), scene.photos["target"])
    # as in a composite, so that the support does not cover the object's foot
    target = replace(target, gaussians=flatten_contact_layers(target.gaussians, [moved]))
    return insert(target, [replace(taken, gaussians=moved)])


def _fitted_to_truth(scene: ExamScene) -> Gaussians:
    """Fit colours of the scene of `true-lights` to the true object and the true shadow in the views of `cameras`.

    The true shadow is the ratio of the true pictures with and without the object, times a render of the target. Errors
    of the reconstruction then count no more than in the other rows.
    """
    source, light = _with_truth("true-lights", scene)
    lit = relight(scene.composite, scene.cameras, sources=[source], light=light).bake()[0]
    images = []
    for view in scene.fitted_views:
        regions = find_regions(view.truth)
        with_object, without = (linear_from_srgb(image) for image in (view.truth.image, view.truth.background))
        shadowed = srgb_from_linear(linear_from_srgb(view.background) * with_object / without.clamp_min(1e-3))
        image = torch.where(regions.rest[..., None], view.picture(lit), shadowed.clamp(0, 1))
        images.append(torch.where(regions.object[..., None], view.truth.image, image))
    return consolidate(lit, scene.cameras, images, ConsolidateOptions(view_error=False))


def _with_truth(row: str, scene: ExamScene) -> tuple[SourceScene, Light | None]:
    with_light = replace(scene.source, light=scene.old_light)
    if row in ("transfer", "clock"):
        return scene.source, None
    if row == "true-new-light":
        return scene.source, scene.new_light
    if row == "true-lights":
        return with_light, scene.new_light
    if row != "true-lights-and-normals":
        raise ValueError(f"--rows: expected names among {', '.join(ROWS)}; found {row}")
    if scene.normals is None:
        raise ValueError("there is no surface.npy")
    return replace(with_light, normals=scene.normals), scene.new_light


LIGHT_ROW = "transfer"
"""Row whose estimates of light and normals are measured."""
METRICS = {"object": "psnr_object", "whole": "psnr_whole", "shadow": "shadow_ratio_rmse"}
"""Names in `measure_view` of a row's values: PSNR in dB of object and whole image, error of the shadow's strength."""
_PICTURED = ("paste", "transfer", "true-lights-and-normals")
_CLOCK_ERROR_DEG = 5.0  # standard deviation of the simulated clock's azimuth
_OPAQUE = 0.3  # minimum opacity of a Gaussian whose normal is measured


@dataclass(frozen=True)
class SceneResult:
    """Measurements on one scene; a value is None if it is not defined."""

    name: str
    rows: dict[str, dict[str, float | None]] = field(default_factory=dict)
    """Values of `METRICS` by row, means over held-out views."""
    light: dict[str, dict[str, float] | None] = field(default_factory=dict)
    """Results of `light_errors` by place, `new` and `old`; None if no light was found."""
    normals_deg: float | None = None
    """Median angle between estimated and true normals of the object, degrees."""
    notes: tuple[str, ...] = ()
    """Reasons for missing rows or values, and the transfer's own notes."""

    @property
    def ratio_level(self) -> float | None:
        """Error of the ratio of new to old light, in stops of its level."""
        new, old = self.light.get("new"), self.light.get("old")
        return None if new is None or old is None else new["level"] - old["level"]

    def as_json(self) -> dict:
        """Convert to plain JSON values."""
        return asdict(self)

    @staticmethod
    def from_json(record: dict) -> "SceneResult":
        """Convert back from the values of `as_json`."""
        return SceneResult(**{**record, "notes": tuple(record["notes"])})


def evaluate_scene(scene: ExamScene, rows: Sequence[str], picture: Path) -> SceneResult:
    """Make and measure the rows of a scene, and write a .png with a column of held-out views for some rows."""
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
            notes += [note.text for note in relit.report]
    columns.append([view.truth.image for view in scene.views])
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_image(picture, torch.cat([torch.cat(column, 0) for column in columns], 1))
    return SceneResult(scene.name, values, light, normals_deg, tuple(notes))


def measure_row(result: Gaussians | ReflectiveScene, views: Sequence[TrueView]) -> dict[str, float | None]:
    """Compute the values of `METRICS`, means over the views in which they are defined."""
    found = [measure_view(view.picture(result), view.truth, background=view.background) for view in views]
    out: dict[str, float | None] = {}
    for short, name in METRICS.items():
        known = [values[name] for values in found if math.isfinite(values[name])]
        out[short] = sum(known) / len(known) if known else None
    return out


def _measure_estimates(scene: ExamScene, relit: Relit) -> tuple[dict[str, dict[str, float] | None], float | None]:
    """Measure both lights, and the normals in degrees, of a transfer that estimates everything."""
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


LIGHT_ERRORS = ("rms", "level", "tint", "direction_deg")


def light_errors(estimated: Light, truth: Light) -> dict[str, float]:
    """Measure an estimated light against the true one.

    Returns:
        Errors over even normals, in stops of the ratio of estimated to true irradiance: `rms` and `level` are the RMS
        and the mean of its gray value (a positive level is too bright), `tint` is the RMS of the channels relative to
        gray. `direction_deg` is the angle between the normals with the highest gray irradiance, degrees.
    """
    normals = even_directions(200)
    colors = [light.irradiance(normals).clamp_min(1e-6) for light in (estimated, truth)]
    grays = [color.mean(1, keepdim=True) for color in colors]
    gray = (grays[0] / grays[1]).log2()
    tint = (colors[0] / colors[1]).log2() - gray
    brightest = [_brightest(light) for light in (estimated, truth)]
    return {
        "rms": _rms(gray),
        "level": float(gray.mean()),
        "tint": _rms(tint),
        "direction_deg": math.degrees(math.acos(max(-1.0, min(1.0, float(brightest[0] @ brightest[1]))))),
    }


def median_angle_deg(one: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"], which: Bool[Tensor, "n"]) -> float | None:
    """Compute the median angle between unit normals, over those that `which` selects; None if it selects none."""
    if not bool(which.any()):
        return None
    return float((one * other).sum(1)[which].clamp(-1, 1).acos().rad2deg().median())


def _rms(values: Tensor) -> float:
    return float((values**2).mean().sqrt())


def _brightest(light: Light) -> Float[Tensor, "3"]:
    normals = even_directions(10_000)  # 2 degrees apart
    return normals[light.irradiance(normals).mean(1).argmax()]
