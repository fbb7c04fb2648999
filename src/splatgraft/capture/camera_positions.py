"""Where one may stand to look at a scene, and from which of these places something stands in the way.

Knows nothing about how the scene's middle and its up were found.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render
from splatgraft.runtime.progress import Progress, silent

HALF_FOV = math.radians(30)
"""Of the width of the pictures."""
LEAST_VIEWS = 8
"""So many poses there are at least, however bad."""
_DISTANCES = (2.4, 1.7, 3.4, 1.2)
"""Over the radius of the dense part, the best first: at 2.4 it fills the picture."""
_HEIGHTS = (0.2, 0.6, 0.0)
"""Of eyes within it, over the same, the best first."""
_BLOCKED = 0.1


@dataclass(frozen=True)
class CameraPosition:
    """An eye and what it looks at."""

    eye: Float[Tensor, "3"]
    """In the world."""
    target: Float[Tensor, "3"]
    """In the world."""
    clear: float
    """What is nearer than this in the middle of the picture is in the way, world units."""
    clear_at_edges: float
    """The same for the picture as a whole."""
    least_seen: float
    """Share of the picture in which something must be seen at all."""


def positions_around(
    centre: Float[Tensor, "3"], radius: float, *, up: Float[Tensor, "3"], views: int
) -> list[list[CameraPosition]]:
    """Per view places along one direction from the centre, the best first; walls before that part are in the way."""
    out = []
    for direction in _directions(views, up, (20.0, 42.0)):
        distances = [k * radius for k in _DISTANCES]
        out.append([CameraPosition(centre + d * direction, centre, d - 1.1 * radius, 0.35 * d, 0.0) for d in distances])
    return out


def positions_within(
    centre: Float[Tensor, "3"], radius: float, *, up: Float[Tensor, "3"], views: int
) -> list[list[CameraPosition]]:
    """Per view eyes near the centre that look out, a step back from it and slightly down."""
    out = []
    for direction in _directions(views, up, (0.0, -25.0)):
        flat = torch.nn.functional.normalize(direction - (direction @ up) * up, dim=0)
        eyes = [centre - 0.3 * radius * flat + k * radius * up for k in _HEIGHTS]
        out.append([CameraPosition(eye, eye + direction, 0.3 * radius, 0.15 * radius, 0.5) for eye in eyes])
    return out


def best_poses(
    scene: Gaussians, views: Sequence[Sequence[CameraPosition]], *, up: Float[Tensor, "3"], progress: Progress = silent
) -> tuple[Float[Tensor, "v 4 4"], int]:
    """Per view the first stand with a free sight; how many have none. Of those the best are taken, up to the least."""
    chosen: list[Tensor] = []
    poor: list[tuple[float, Tensor]] = []
    for index, stands in enumerate(views):
        tried = [_tried(scene, stand, up) for stand in stands]
        free = [pose for pose, blocked in tried if blocked < _BLOCKED]
        if free:
            chosen.append(free[0])
        else:
            poor.append(min(((blocked, pose) for pose, blocked in tried), key=lambda pair: pair[0]))
        progress(index + 1, len(views), "places to look from")
    missing = max(0, LEAST_VIEWS - len(chosen))
    chosen += [pose for _, pose in sorted(poor, key=lambda pair: pair[0])[:missing]]
    return torch.stack(chosen), len(poor)


def _tried(scene: Gaussians, stand: CameraPosition, up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "4 4"], float]:
    """A pose, and the share of its picture in which something stands in the way."""
    pose = look_at(stand.eye[None], stand.target, up)
    small = pinhole(pose, 24 / math.tan(HALF_FOV), width=48, height=36)
    seen = render(scene, small, outputs=frozenset({"depth"}))
    depth, alpha = seen.depth[0], seen.alpha[0]
    close = float((alpha * (depth < stand.clear_at_edges)).mean())
    hidden = float((alpha * (depth < stand.clear))[12:24, 16:32].mean())
    unseen = 1.0 if float(alpha.mean()) < stand.least_seen else 0.0
    return pose[0], max(close, 0.3 * hidden, unseen)


def _directions(views: int, up: Float[Tensor, "3"], elevations_deg: tuple[float, ...]) -> Float[Tensor, "v 3"]:
    """Unit directions from the centre: rings at several elevations, turned against one another."""
    side = torch.eye(3)[int(up.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(side, up), dim=0)
    y = torch.linalg.cross(up, x)
    index = torch.arange(views)
    azimuth = 2 * math.pi * index / views
    elevation = torch.deg2rad(torch.tensor(elevations_deg))[index % len(elevations_deg)]
    flat = azimuth.cos()[:, None] * x + azimuth.sin()[:, None] * y
    return elevation.cos()[:, None] * flat + elevation.sin()[:, None] * up
