"""Which points of a placed object the target's surfaces hide from cameras, by comparison with rendered depth."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render

_WIDTH_PX = 240
"""Width of the depth images, enough for shares of points."""


@dataclass(frozen=True)
class HiddenOptions:
    """How the hidden share of an object is measured; values set by hand."""

    views: int = 12
    """Cameras that are tried, evenly spaced."""
    slack: float = 0.03
    """Depth by which a point may lie behind the surface, over the object's extent: the width of both surfaces."""
    trimmed: float = 0.05
    """Share of points beyond either end of the extent."""


def hidden_fraction(
    target: Gaussians, placed: Gaussians, *, cameras: Cameras, options: HiddenOptions = HiddenOptions()
) -> float:
    """Share of an object, by opacity, that the target's surfaces hide from all cameras, as inside a wall.

    Args:
        target: Scene without the object.
        placed: Object in the frame of the target.
        cameras: Of the target; a part outside the images of all chosen ones counts as hidden.
        options: Which cameras are chosen, and the tolerance.

    Returns:
        In [0, 1].
    """
    points = placed.means
    if placed.count == 0:
        return 0.0
    low, high = options.trimmed, 1 - options.trimmed
    extent = float((points.quantile(high, 0) - points.quantile(low, 0)).norm()) if placed.count > 1 else 0.0
    seen = torch.zeros(placed.count, dtype=torch.bool)
    for camera in small_cameras(cameras, options.views):
        seen |= visible_points(target, points, camera=camera, slack=options.slack * extent)
    weight = placed.opacities
    return float((weight * ~seen).sum() / weight.sum())


def small_cameras(cameras: Cameras, count: int, width_px: int = _WIDTH_PX) -> list[Cameras]:
    """`count` evenly spaced cameras as batches of one, reduced to `width_px` where they are wider."""
    return [camera.resized(min(1.0, width_px / camera.width)) for camera in cameras.spread(count)]


def visible_points(scene: Gaussians, points: Float[Tensor, "m 3"], *, camera: Cameras, slack: float) -> Tensor:
    """Bool[m]: points inside the camera's image and at most `slack`, world units, behind the scene's surface."""
    depth, pixels, inside = project(points, camera)
    rendered = render(scene, camera, outputs=frozenset({"depth"}))
    column, row = pixels.long().unbind(-1)
    column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
    surface, alpha = rendered.depth[0].detach()[row, column], rendered.alpha[0].detach()[row, column]
    return inside & ((alpha < 0.5) | (depth <= surface + slack))


def project(points: Float[Tensor, "m 3"], camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Depth Float[m], pixel Float[m 2], and Bool[m] whether the point lies inside the camera's image."""
    pose = camera.camera_from_world[0].to(points)
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = in_camera[:, 2]
    intrinsics = camera.intrinsics[0].to(points)
    pixels = (in_camera @ intrinsics.T)[:, :2] / depth.clamp_min(1e-9)[:, None]
    size = camera.sizes[0].to(points)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
    return depth, pixels.nan_to_num(0).clamp(-1e6, 1e6), inside
