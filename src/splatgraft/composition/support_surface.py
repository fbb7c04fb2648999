"""The level surface below a point of a scene. Knows nothing about objects."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.composition.height_map import height_map
from splatgraft.core.gaussians import Gaussians

_STEEPEST = 0.35
"""Sine of the greatest slope that still counts as level: 20 degrees, most of it errors of the estimated up."""


@dataclass(frozen=True)
class Support:
    """A plane that something can stand on."""

    point: Float[Tensor, "3"]
    """On the plane, straight below the point asked for."""
    normal: Float[Tensor, "3"]
    """Unit, upwards."""
    flat_fraction: float
    """Share of the disc around it that lies on the plane, in [0, 1]."""
    obstructed_fraction: float
    """Share of the disc that rises above the plane, in [0, 1]."""


def support_below(
    scene: Gaussians,
    point: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    radius: float,
    clearance: float | None = None,
) -> Support:
    """The surface that fills most of the disc of `radius` under `point`, seen from `clearance` above it downwards.

    What hangs higher, such as a ceiling or a lamp, is not seen. `clearance` is a quarter of the radius by default, so
    that a point on the very surface finds it in spite of noise.

    Raises: ValueError where nothing level lies below.
    """
    up = torch.nn.functional.normalize(up.to(scene.means), dim=0)
    point = point.to(scene.means)
    seen = height_map(scene, point, up=up, radius=radius, top=radius / 4 if clearance is None else clearance, size=64)
    disc = seen.offsets.norm(dim=-1) <= radius
    # half-transparent is a floater or a rim, not a place to stand
    solid = disc & (seen.alpha > 0.5)
    where = ", ".join(f"{x:.3g}" for x in point.tolist())
    if int(solid.sum()) < 0.15 * int(disc.sum()):
        share = float(solid.sum() / disc.sum())
        raise ValueError(f"placement: expected a surface below ({where}), found {share:.0%} of the ground covered")
    points = seen.points[solid] - point
    on_plane, normal, height = _fit_level_plane(points, seen.heights[solid], up=up, radius=radius)
    flat = float(on_plane.sum() / disc.sum())
    if flat < 0.15:
        raise ValueError(f"placement: expected a level surface below ({where}), found {flat:.0%} of the ground level")
    above = (points @ normal - height) > 0.1 * radius
    return Support(
        point=point + up * height / (normal @ up),
        normal=normal,
        flat_fraction=flat,
        obstructed_fraction=float((above & ~on_plane).sum() / disc.sum()),
    )


def _fit_level_plane(
    points: Float[Tensor, "m 3"], heights: Float[Tensor, "m"], *, up: Float[Tensor, "3"], radius: float
) -> tuple[Bool[Tensor, "m"], Float[Tensor, "3"], Float[Tensor, ""]]:
    """Points on the commonest level, its normal and its distance along the normal from the origin."""
    step = 0.05 * radius
    # votes smoothed over three steps: noise and a slight slope spread one surface over several
    votes = torch.bincount(((heights - heights.min()) / step).long())
    smooth = torch.nn.functional.conv1d(votes[None, None].float(), torch.ones(1, 1, 5), padding=2)[0, 0]
    level = heights.min() + (float(smooth.argmax()) + 0.5) * step
    normal, distance = up, level
    # from wide enough for 20 degrees of slope to what counts as the same surface
    for tolerance in (0.3, 0.2, 0.12, 0.08, 0.06, 0.06):
        near = (points @ normal - distance).abs() < tolerance * radius
        if int(near.sum()) < 8:
            break
        chosen = points[near].double()
        middle = chosen.mean(0)
        _, _, axes = torch.linalg.svd(chosen - middle, full_matrices=False)
        candidate = axes[2] * torch.sign(axes[2] @ up.double())
        if float(candidate @ up.double()) < (1 - _STEEPEST**2) ** 0.5:
            break
        normal = candidate.to(points)
        distance = (middle @ candidate).to(points)
    height = heights[(heights - level).abs() < 0.06 * radius].median()
    misses = [(points @ n - d).abs().clamp_max(0.12 * radius).mean() for n, d in ((normal, distance), (up, height))]
    # a slope that explains little more than none does is noise of the reconstruction
    if misses[0] > 0.7 * misses[1]:
        normal, distance = up, height
    near = (points @ normal - distance).abs() < 0.06 * radius
    return near, normal, distance
