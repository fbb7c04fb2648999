"""Visibility of points of a target scene in its cameras' views, by comparison with rendered depth.

A point is visible if it lies inside the image and not behind the scene's surface, as in shadow mapping.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render

# set by hand
VIEWS = 12
"""Number of evenly spaced cameras in which points are tested."""
_VIEW_WIDTH_PX = 240  # width of the depth images
_IMAGE_MARGIN = 0.05  # border of the image in which a point does not count as visible, over the image size
_SLACK = 0.03  # largest depth behind the surface, over the object's extent: the width of both surfaces
_EXTENT_TRIM = 0.05  # share of points beyond either end of the extent


def hidden_fraction(target: Gaussians, placed: Gaussians, *, cameras: Cameras) -> float:
    """Compute the share of an object, by opacity, that the target's surfaces hide from all cameras; in [0, 1].

    A part outside the images of all chosen cameras counts as hidden. A large share means that the object sticks in a
    wall or in furniture.
    """
    points = placed.means
    if placed.count == 0:
        return 0.0
    low, high = _EXTENT_TRIM, 1 - _EXTENT_TRIM
    extent = float((points.quantile(high, 0) - points.quantile(low, 0)).norm()) if placed.count > 1 else 0.0
    seen = torch.zeros(placed.count, dtype=torch.bool)
    for camera in small_cameras(cameras):
        seen |= visible_points(target, points, camera=camera, slack=_SLACK * extent)
    weight = placed.opacities
    return float((weight * ~seen).sum() / weight.sum())


def visible_share(
    target: Gaussians, points: Float[Tensor, "m 3"], *, cameras: Cameras, slack: float
) -> Float[Tensor, "m"]:
    """Compute the share of the views in which each point is visible and off the image's border, in [0, 1]."""
    views = small_cameras(cameras)
    count = torch.zeros(len(points))
    for camera in views:
        _, pixels, _ = project(points, camera)
        size = camera.sizes[0].to(points)
        central = ((pixels > _IMAGE_MARGIN * size) & (pixels < (1 - _IMAGE_MARGIN) * size)).all(-1)
        count += central & visible_points(target, points, camera=camera, slack=slack)
    return count / len(views)


def small_cameras(cameras: Cameras) -> list[Cameras]:
    """Choose evenly spaced cameras, as batches of one; images wider than 240 pixels are reduced."""
    return [camera.resized(min(1.0, _VIEW_WIDTH_PX / camera.width)) for camera in cameras.spread(VIEWS)]


def visible_points(
    scene: Gaussians, points: Float[Tensor, "m 3"], *, camera: Cameras, slack: float
) -> Bool[Tensor, "m"]:
    """Find the points inside the camera's image and at most `slack`, world units, behind the scene's surface."""
    depth, pixels, inside = project(points, camera)
    rendered = render(scene, camera, outputs=frozenset({"depth"}))
    column, row = pixels.long().unbind(-1)
    column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
    surface, alpha = rendered.depth[0].detach()[row, column], rendered.alpha[0].detach()[row, column]
    return inside & ((alpha < 0.5) | (depth <= surface + slack))


def project(
    points: Float[Tensor, "m 3"], camera: Cameras
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m 2"], Bool[Tensor, "m"]]:
    """Compute the depth and the pixel of each point, and whether it lies inside the camera's image."""
    pixels, depth = camera.project(points)
    size = camera.sizes[0].to(points)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
    return depth, pixels.nan_to_num(0).clamp(-1e6, 1e6), inside
