"""The level surface below a point of a scene: the most frequent level of a height map, refined by least squares."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.composition.height_map import height_map
from splatgraft.core.gaussians import Gaussians


@dataclass(frozen=True)
class SupportOptions:
    """What counts as a level surface; lengths over the radius of the disc, values set by hand."""

    steepest: float = 0.35
    """Sine of the largest slope that counts as level: 20 degrees, mainly for errors of the estimated up."""
    clearance: float = 0.25
    """Height above the point from which the surface is searched downwards, where it is not given."""
    map_size: int = 64
    """Width and height of the height map, pixels."""
    least_pixels: int = 8
    """Solid pixels of the height map below which there is no surface."""
    widened: tuple[float, ...] = (1.0, 2.0, 4.0)
    """Radii of the discs, over the given one, until one has a surface: the place may be a hole in the scene."""
    level_step: float = 0.05
    """Width of a bin of the histogram of heights."""
    tolerances: tuple[float, ...] = (0.3, 0.2, 0.12, 0.08, 0.06, 0.06)
    """Distance from the plane of the points that each fit takes: from 20 degrees of slope to surface noise."""
    on_surface: float = 0.06
    """Largest distance from the plane of a point that lies on it."""
    above: float = 0.1
    """Least distance above the plane of a point that obstructs the disc."""
    capped_error: float = 0.12
    """Bound on the distance of a point when a sloped plane is compared with a level one."""
    slope_gain: float = 0.7
    """Largest error of the sloped plane over that of the level one; a slope that explains less is noise."""


@dataclass(frozen=True)
class Support:
    """A level plane that can carry an object."""

    point: Float[Tensor, "3"]
    """On the plane, straight below the given point."""
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
    options: SupportOptions = SupportOptions(),
) -> Support:
    """The surface that fills most of a horizontal disc below `point`, level as far as one is.

    It may be poor, as on a heap of things or a steep slope: `flat_fraction` says how much of the disc lies on it.

    Args:
        scene: What is seen from above.
        point: World units; may lie on the surface.
        up: Of any length but zero.
        radius: Of the disc, world units.
        clearance: Height above `point` from which the search starts, world units; what is higher, such as a lamp, is
            ignored. None takes a share of the radius, so that a point on a noisy surface finds it.
        options: What counts as level.

    Raises:
        ValueError: Where no surface lies below.
    """
    up = torch.nn.functional.normalize(up.to(scene.means), dim=0)
    point = point.to(scene.means)
    top = options.clearance * radius if clearance is None else clearance
    for factor in options.widened:
        ground = height_map(scene, point, up=up, radius=factor * radius, top=top, size=options.map_size)
        disc = ground.offsets.norm(dim=-1) <= factor * radius
        # what is half transparent is a floater or an edge
        solid = disc & (ground.alpha > 0.5)
        if int(solid.sum()) >= options.least_pixels:
            break
    else:
        where = ", ".join(f"{x:.3g}" for x in point.tolist())
        raise ValueError(f"placement: expected a surface below ({where}), found none; name another point")
    points = ground.points[solid] - point
    on_plane, normal, height = _fit_level_plane(points, ground.heights[solid], up=up, radius=radius, options=options)
    flat = float(on_plane.sum() / disc.sum())
    above = (points @ normal - height) > options.above * radius
    return Support(
        point=point + up * height / (normal @ up),
        normal=normal,
        flat_fraction=flat,
        obstructed_fraction=float((above & ~on_plane).sum() / disc.sum()),
    )


def _fit_level_plane(
    points: Float[Tensor, "m 3"],
    heights: Float[Tensor, "m"],
    *,
    up: Float[Tensor, "3"],
    radius: float,
    options: SupportOptions,
) -> tuple[Bool[Tensor, "m"], Float[Tensor, "3"], Float[Tensor, ""]]:
    """Points on the most frequent level, its normal and its distance along the normal from the origin."""
    step = options.level_step * radius
    # a moving sum of five bins: noise and a slight slope spread one surface over several
    counts = torch.bincount(((heights - heights.min()) / step).long())
    smooth = torch.nn.functional.conv1d(counts[None, None].float(), torch.ones(1, 1, 5), padding=2)[0, 0]
    level = heights.min() + (float(smooth.argmax()) + 0.5) * step
    normal, distance = up, level
    for tolerance in options.tolerances:
        near = (points @ normal - distance).abs() < tolerance * radius
        if int(near.sum()) < 8:
            break
        chosen = points[near].double()
        middle = chosen.mean(0)
        _, _, axes = torch.linalg.svd(chosen - middle, full_matrices=False)
        candidate = axes[2] * torch.sign(axes[2] @ up.double())
        if float(candidate @ up.double()) < (1 - options.steepest**2) ** 0.5:
            break
        normal = candidate.to(points)
        distance = (middle @ candidate).to(points)
    height = heights[(heights - level).abs() < options.on_surface * radius].median()
    cap = options.capped_error * radius
    errors = [(points @ n - d).abs().clamp_max(cap).mean() for n, d in ((normal, distance), (up, height))]
    if errors[0] > options.slope_gain * errors[1]:
        normal, distance = up, height
    near = (points @ normal - distance).abs() < options.on_surface * radius
    return near, normal, distance
