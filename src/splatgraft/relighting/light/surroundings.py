"""What a place's surroundings show of the light on it: captured radiance per direction, what is clipped or unseen."""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.relighting.light.panorama import Panorama, cube_directions, cube_pixels, render_panorama

DIRECTIONS = even_directions(320)
"""Unit directions into which all light is sorted: 11 degrees apart, as fine as the surfaces around tell it."""
SOLID_ANGLE = 4 * math.pi / len(DIRECTIONS)
"""Steradians of each direction."""
_TABLE = 64
"""Pixels; width of a face of the cube map that tells which of the directions is nearest."""
FARTHEST = 1e4
"""World units; what is farther away counts as so far."""


@dataclass(frozen=True)
class SurroundingsSettings:
    """What counts as captured and as clipped."""

    size: int = 48
    """Pixels; width of a face of the panorama."""
    least_alpha: float = 0.3
    """Alpha below which nothing was captured."""
    clipped: float = 0.955
    """sRGB of the brightest channel from which a camera may have clipped; reconstruction loses a little."""


@dataclass(frozen=True)
class Surroundings:
    """The light around a place, sorted into the k `DIRECTIONS`."""

    radiance: Float[Tensor, "k 3"]
    """Captured linear radiance times the captured share."""
    seen: Float[Tensor, "k"]
    """Share of each direction that some camera photographed, in [0, 1]."""
    clipped: Float[Tensor, "k"]
    """Share that is as bright as a camera records, in [0, 1]; the light there may be brighter."""
    clipped_direction: Float[Tensor, "k 3"]
    """Unit, the middle of that part."""
    distance: Float[Tensor, "k"]
    """World units to what was captured there, the harmonic mean; infinite where nothing was."""


def surroundings_at(
    scene: Gaussians,
    cameras: Cameras,
    center: Float[Tensor, "3"],
    *,
    nearest: float,
    settings: SurroundingsSettings = SurroundingsSettings(),
) -> Surroundings:
    """Sort what a scene shows around a point into directions.

    What no camera looked at is not seen, whatever the Gaussians show there.

    Args:
        scene: All Gaussians.
        cameras: Of the scene's capture.
        center: World units.
        nearest: World units; Gaussians whose centre is nearer are left out.
        settings: Thresholds.
    """
    panorama = render_panorama(scene, center, size=settings.size, nearest=nearest, with_distance=True)
    known = _photographed(_points(panorama, center), cameras)
    known &= panorama.alpha.flatten() > settings.least_alpha
    directions, angles = panorama.directions.reshape(-1, 3), panorama.solid_angles.flatten()
    radiance = panorama.radiance.reshape(-1, 3)
    clipped = known & (radiance.max(1).values > float(linear_from_srgb(torch.tensor(settings.clipped))))
    seen = known * panorama.alpha.flatten().clamp(0, 1)
    nearest_direction = nearest_directions(directions)
    total = _sum(angles, nearest_direction).clamp_min(1e-9)
    assert panorama.distance is not None
    away = panorama.distance.flatten().clamp(1e-6, FARTHEST)
    towards = _sum((angles * clipped)[:, None] * directions, nearest_direction)
    some = towards.norm(dim=1, keepdim=True) > 1e-6
    return Surroundings(
        radiance=_sum((angles * seen)[:, None] * radiance, nearest_direction) / total[:, None],
        seen=_sum(angles * seen, nearest_direction) / total,
        clipped=_sum(angles * clipped, nearest_direction) / total,
        distance=_sum(angles * seen, nearest_direction).clamp_min(1e-12)
        / _sum(angles * seen / away, nearest_direction),
        clipped_direction=torch.where(some, torch.nn.functional.normalize(towards, dim=1), DIRECTIONS),
    )


def nearest_directions(towards: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Position in `DIRECTIONS` of the one nearest to each unit direction, up to the width of a table's cell, 1.4
    degrees."""
    return _nearest_table()[cube_pixels(towards, _TABLE)]


@cache
def _nearest_table() -> Int[Tensor, "c"]:
    return (cube_directions(_TABLE)[0].reshape(-1, 3) @ DIRECTIONS.T).argmax(1)


def _sum(values: Float[Tensor, "p ..."], index: Int[Tensor, "p"]) -> Float[Tensor, "k ..."]:
    return torch.zeros(len(DIRECTIONS), *values.shape[1:]).index_add_(0, index, values)


def _points(panorama: Panorama, center: Float[Tensor, "3"]) -> Float[Tensor, "p 3"]:
    """Where the surfaces of a panorama are."""
    assert panorama.distance is not None
    return center + panorama.directions.reshape(-1, 3) * panorama.distance.reshape(-1, 1).clamp(0, FARTHEST)


def _photographed(points: Float[Tensor, "p 3"], cameras: Cameras) -> Bool[Tensor, "p"]:
    """Whether a point is within some camera's picture; what is in front of it is not tested."""
    found = torch.zeros(len(points), dtype=torch.bool)
    whole = torch.cat([points, torch.ones(len(points), 1)], 1)
    for i in range(len(cameras)):
        in_camera = whole @ cameras.camera_from_world[i, :3].T
        pixels = in_camera @ cameras.intrinsics[i].T
        pixels = pixels[:, :2] / pixels[:, 2:].clamp_min(1e-6)
        found |= (in_camera[:, 2] > 0) & (pixels > 0).all(1) & (pixels < cameras.sizes[i].float()).all(1)
    return found
