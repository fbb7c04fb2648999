"""Whether a placed object is buried in the target. Knows nothing about how it was placed."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render

_VIEWS = 12
_WIDTH_PX = 240


def hidden_fraction(target: Gaussians, placed: Gaussians, *, cameras: Cameras) -> float:
    """Share of an object, by opacity, that no camera can see past the target's surfaces: inside a wall, under a table.

    Twelve of the cameras, evenly taken, are asked. A part outside all their images counts as hidden too.
    """
    points = placed.means
    if placed.count == 0:
        return 0.0
    extent = float((points.quantile(0.95, 0) - points.quantile(0.05, 0)).norm()) if placed.count > 1 else 0.0
    seen = torch.zeros(placed.count, dtype=torch.bool)
    for camera in spread_cameras(cameras, _VIEWS):
        # a part may lie behind the surface by the thickness of both surfaces' Gaussians
        seen |= visible_points(target, points, camera=camera, slack=0.03 * extent)
    weight = placed.opacities
    return float((weight * ~seen).sum() / weight.sum())


def spread_cameras(cameras: Cameras, count: int, width_px: int = _WIDTH_PX) -> list[Cameras]:
    """`count` cameras evenly taken from all, one by one, shrunk to `width_px` where they are larger."""
    chosen = torch.linspace(0, len(cameras) - 1, min(count, len(cameras))).round().long()
    picked = [cameras[int(i)] for i in chosen]
    return [camera.resized(min(1.0, width_px / camera.width)) for camera in picked]


def visible_points(scene: Gaussians, points: Float[Tensor, "m 3"], *, camera: Cameras, slack: float) -> Tensor:
    """Bool[m]: which points one camera has in its image, not more than `slack` behind the scene's surface."""
    depth, pixels, inside = project(points, camera)
    seen = render(scene, camera, outputs=frozenset({"depth"}))
    column, row = pixels.long().unbind(-1)
    column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
    surface, alpha = seen.depth[0].detach()[row, column], seen.alpha[0].detach()[row, column]
    return inside & ((alpha < 0.5) | (depth <= surface + slack))


def project(points: Float[Tensor, "m 3"], camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Depth Float[m], pixel Float[m 2], and Bool[m] whether the point lies within one camera's image."""
    pose = camera.camera_from_world[0].to(points)
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = in_camera[:, 2]
    intrinsics = camera.intrinsics[0].to(points)
    pixels = (in_camera @ intrinsics.T)[:, :2] / depth.clamp_min(1e-9)[:, None]
    size = camera.sizes[0].to(points)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
    return depth, pixels.nan_to_num(0).clamp(-1e6, 1e6), inside
