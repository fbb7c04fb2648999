"""Virtual camera positions around a scene or within it, with occluded positions removed by rendering the scene."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import perpendicular
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render
from splatgraft.runtime.progress import Progress, silent

HALF_FOV = math.radians(30)
"""Half the horizontal field of view of the pictures, radians."""
LEAST_VIEWS = 8
"""Number of poses that are kept even where they are occluded."""


@dataclass(frozen=True)
class PositionOptions:
    """Candidate positions and what occludes them; lengths over the radius of the dense part, values set by hand."""

    distances: tuple[float, ...] = (2.4, 1.7, 3.4, 1.2)
    """From the centre, around the dense part, the best first: at 2.4 it fills the picture."""
    elevations_deg: tuple[float, ...] = (20.0, 42.0)
    """Of the rings around the dense part."""
    clear: float = 1.1
    """Distance from the centre towards the eye beyond which anything occludes the dense part."""
    clear_at_edges: float = 0.35
    """Distance from the eye, over that of the centre, below which anything occludes the picture."""
    heights: tuple[float, ...] = (0.2, 0.6, 0.0)
    """Of eyes within the scene above the centre, the best first."""
    elevations_within_deg: tuple[float, ...] = (0.0, -25.0)
    """Of views out of the scene."""
    step_back: float = 0.3
    """Horizontal distance of eyes within the scene from the centre, against the view."""
    clear_within: float = 0.3
    """Distance from an eye within the scene below which anything occludes the middle of the picture."""
    clear_at_edges_within: float = 0.15
    """Distance from such an eye below which anything occludes the picture."""
    least_seen_within: float = 0.5
    """Least mean opacity of a picture from within."""
    occluded: float = 0.1
    """Occluded share from which a position is not taken."""
    middle_weight: float = 0.3
    """Factor on the occluded share of the picture's middle against that of the whole picture."""


@dataclass(frozen=True)
class CameraPosition:
    """An eye, the point it looks at, and what occludes it."""

    eye: Float[Tensor, "3"]
    """World units."""
    target: Float[Tensor, "3"]
    """World units."""
    clear: float
    """Depth below which anything in the middle of the picture occludes it, world units."""
    clear_at_edges: float
    """The same for the whole picture."""
    least_seen: float
    """Least mean opacity of the picture, in [0, 1]."""


def positions_around(
    centre: Float[Tensor, "3"],
    radius: float,
    *,
    up: Float[Tensor, "3"],
    views: int,
    options: PositionOptions = PositionOptions(),
) -> list[list[CameraPosition]]:
    """Candidate positions around a scene that look at its centre.

    Args:
        centre: Of the dense part.
        radius: Of the dense part, world units.
        up: Unit.
        views: Number of directions from the centre.
        options: Distances and elevations.

    Returns:
        Per view positions along one direction, the best first.
    """
    out = []
    for direction in _directions(views, up, options.elevations_deg):
        distances = [k * radius for k in options.distances]
        edges = [options.clear_at_edges * d for d in distances]
        out.append(
            [
                CameraPosition(centre + d * direction, centre, d - options.clear * radius, edge, 0.0)
                for d, edge in zip(distances, edges, strict=True)
            ]
        )
    return out


def positions_within(
    centre: Float[Tensor, "3"],
    radius: float,
    *,
    up: Float[Tensor, "3"],
    views: int,
    options: PositionOptions = PositionOptions(),
) -> list[list[CameraPosition]]:
    """Candidate positions near a scene's centre that look outwards, on the whole slightly down.

    Arguments and result are those of `positions_around`.
    """
    out = []
    for direction in _directions(views, up, options.elevations_within_deg):
        flat = torch.nn.functional.normalize(direction - (direction @ up) * up, dim=0)
        eyes = [centre - options.step_back * radius * flat + k * radius * up for k in options.heights]
        clear, edges = options.clear_within * radius, options.clear_at_edges_within * radius
        seen = options.least_seen_within
        out.append([CameraPosition(eye, eye + direction, clear, edges, seen) for eye in eyes])
    return out


def unoccluded_poses(
    scene: Gaussians,
    views: Sequence[Sequence[CameraPosition]],
    *,
    up: Float[Tensor, "3"],
    options: PositionOptions = PositionOptions(),
    progress: Progress = silent,
) -> tuple[Float[Tensor, "v 4 4"], int]:
    """Poses at the first position of each view that is not occluded, tested by rendering the scene at 48 x 36 pixels.

    Args:
        scene: What occludes.
        views: Candidate positions of each view, the best first.
        up: Unit.
        options: What counts as occluded.
        progress: Called after each view.

    Returns:
        The poses, and the number of views without such a position. Of these the least occluded poses are added while
        there are fewer than `LEAST_VIEWS`.
    """
    chosen: list[Tensor] = []
    rejected: list[tuple[float, Tensor]] = []
    for index, positions in enumerate(views):
        tried = [_pose_and_occlusion(scene, position, up, options) for position in positions]
        free = [pose for pose, occluded in tried if occluded < options.occluded]
        if free:
            chosen.append(free[0])
        else:
            rejected.append(min(((occluded, pose) for pose, occluded in tried), key=lambda pair: pair[0]))
        progress(index + 1, len(views), "placing virtual cameras")
    missing = max(0, LEAST_VIEWS - len(chosen))
    chosen += [pose for _, pose in sorted(rejected, key=lambda pair: pair[0])[:missing]]
    return torch.stack(chosen), len(rejected)


def _pose_and_occlusion(
    scene: Gaussians, position: CameraPosition, up: Float[Tensor, "3"], options: PositionOptions
) -> tuple[Float[Tensor, "4 4"], float]:
    """A pose, and the occluded share of its picture."""
    pose = look_at(position.eye[None], position.target, up)
    small = pinhole(pose, 24 / math.tan(HALF_FOV), width=48, height=36)
    rendered = render(scene, small, outputs=frozenset({"depth"}))
    depth, alpha = rendered.depth[0], rendered.alpha[0]
    close = float((alpha * (depth < position.clear_at_edges)).mean())
    hidden = float((alpha * (depth < position.clear))[12:24, 16:32].mean())
    unseen = 1.0 if float(alpha.mean()) < position.least_seen else 0.0
    return pose[0], max(close, options.middle_weight * hidden, unseen)


def _directions(views: int, up: Float[Tensor, "3"], elevations_deg: tuple[float, ...]) -> Float[Tensor, "v 3"]:
    """Unit directions from the centre, evenly spaced in azimuth, at the elevations in turn."""
    x = -perpendicular(up)
    y = torch.linalg.cross(up, x)
    index = torch.arange(views)
    azimuth = 2 * math.pi * index / views
    elevation = torch.deg2rad(torch.tensor(elevations_deg))[index % len(elevations_deg)]
    flat = azimuth.cos()[:, None] * x + azimuth.sin()[:, None] * y
    return elevation.cos()[:, None] * flat + elevation.sin()[:, None] * up
