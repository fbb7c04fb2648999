"""Errors of an estimated light against the true one, both as irradiance without occlusion, and of normals."""

import math

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import even_directions
from splatgraft.relighting import Light

_NORMALS = 200
"""Even directions over which errors of irradiance are averaged."""
_FINE_NORMALS = 10_000
"""Even directions among which the one of most irradiance is looked for; 2 degrees apart."""
_DARKEST = 1e-6
"""Linear irradiance; less counts as this."""

_CELLS = 80
"""Width of the image in whose cells surface points are compared; the object takes up half of it or less."""
_BEHIND = 0.05
"""Of the object's size: how far behind the nearest point a point is still seen."""

LIGHT_ERRORS = ("rms", "level", "tint", "direction_deg")


def light_errors(estimated: Light, truth: Light) -> dict[str, float]:
    """Measure an estimated light against the true one.

    Args:
        estimated: The estimate.
        truth: In the same frame.

    Returns:
        `rms`: of log2 of the ratio of gray irradiance over even normals, stops; `level`: its mean, positive where the
        estimate is too bright; `tint`: RMS over normals and channels of log2 of the ratio of irradiance over that of
        gray irradiance, stops; `direction_deg`: angle between the normals of most gray irradiance.
    """
    normals = even_directions(_NORMALS)
    colors = [light.irradiance(normals).clamp_min(_DARKEST) for light in (estimated, truth)]
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


def seen_surface(surface: Float[Tensor, "m 6"], cameras: Cameras) -> Float[Tensor, "s 6"]:
    """The surface points that some camera sees: not what lies inside of the object or under it.

    A point is seen where it faces the camera and no point in its cell of an image is nearer by more than a share
    of the object's size.

    Args:
        surface: Positions and unit normals of m points, ten or more per cell.
        cameras: That the object was captured with.
    """
    points, normals = surface[:, :3], surface[:, 3:]
    middle, size = points.mean(0), float((points - points.mean(0)).norm(dim=1).max())
    seen = torch.zeros(len(points), dtype=torch.bool)
    for i in range(len(cameras)):
        pose = cameras.camera_from_world[i]
        depth = points @ pose[2, :3] + pose[2, 3]
        if float(depth.min()) <= 0:
            continue
        plane = (points @ pose[:2, :3].T + pose[:2, 3]) / depth[:, None]
        half = size / float(middle @ pose[2, :3] + pose[2, 3])
        cells = ((plane - plane.mean(0)) / half * _CELLS / 4 + _CELLS / 2).long().clamp(0, _CELLS - 1)
        index = cells[:, 1] * _CELLS + cells[:, 0]
        nearest = torch.full((_CELLS**2,), torch.inf).scatter_reduce(0, index, depth, "amin")
        facing = ((cameras.centers[i] - points) * normals).sum(1) > 0
        seen |= facing & (depth < nearest[index] + _BEHIND * size)
    return surface[seen]


def nearest_normals(points: Float[Tensor, "n 3"], surface: Float[Tensor, "m 6"]) -> Float[Tensor, "n 3"]:
    """The outward normal of the nearest of m surface points (position and unit normal) to each point."""
    nearest = KDTree(surface[:, :3].numpy()).query(points.numpy())[1]
    return surface[torch.from_numpy(nearest), 3:].contiguous()


def median_angle_deg(one: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"], which: Bool[Tensor, "n"]) -> float | None:
    """The median angle between unit normals, over those that `which` chooses; None where it chooses none."""
    if not bool(which.any()):
        return None
    return float((one * other).sum(1)[which].clamp(-1, 1).acos().rad2deg().median())


def _rms(values: Tensor) -> float:
    return float((values**2).mean().sqrt())


def _brightest(light: Light) -> Float[Tensor, "3"]:
    normals = even_directions(_FINE_NORMALS)
    return normals[light.irradiance(normals).mean(1).argmax()]
