"""Normals of an object's Gaussians from the depth images of its capture's cameras, joined with those of its neighbours.

The inverse depth of a plane is linear in the pixel, so its gradient, fitted over a small window, is the normal. Every
Gaussian takes the mean over the pixels that it covers in all views; the shape of the surrounding Gaussians
(`estimate_normals`) decides as far as it is flat, and wherever no camera looks.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shading.object_views import ObjectView

_normalize = torch.nn.functional.normalize


@dataclass(frozen=True)
class DepthNormalSettings:
    """How depth becomes normals; chosen on eight scenes with true normals, flat around these values."""

    reach: int = 2
    """Pixels from the middle of the fitted window to its edge; the best of 1, 2, 3."""
    window: float = 1.4
    """Pixels; standard deviation of the window's weights."""
    same_surface: float = 0.1
    """Radii of the object; standard deviation of depth within a window, so that edges are not bridged."""
    covered: float = 0.5
    """A pixel of at least this alpha shows the object."""
    least_filled: float = 0.3
    """Share of the window's weight that must lie on the object."""
    least_pixels: float = 0.5
    """Pixels that a Gaussian covers in all views together, where depth and neighbours count alike."""
    neighbours: float = 0.5
    """Weight of the neighbours' normal times its confidence, beside the depth's of 1."""


def fuse_normals(
    gaussians: Gaussians,
    views: tuple[ObjectView, ...],
    neighbours: Normals,
    *,
    radius: float,
    settings: DepthNormalSettings = DepthNormalSettings(),
) -> Normals:
    """Normals from depth images and neighbours together.

    Args:
        gaussians: The n Gaussians of an object.
        views: Of the object alone.
        neighbours: Estimate from the Gaussians' own shapes; returned as it is where there are no views.
        radius: Of the object, world units.
        settings: Windows and weights.

    Returns:
        Normals, of which `confidence` is the agreement of both, in [0, 1].
    """
    total = torch.zeros(gaussians.count, 4)
    for view in views:
        normals, weight = _normals_of(_inverse_depth(gaussians, view, settings), view, radius, settings)
        total += view.operator.blend_transpose(torch.cat([normals * weight, weight], 2).contiguous())
    pixels = total[:, 3:]
    by_depth = _normalize(total[:, :3], dim=1) * pixels / (pixels + settings.least_pixels)
    by_shape = (settings.neighbours * neighbours.confidence[:, None] + 1e-3) * neighbours.vectors
    joined = by_depth + by_shape
    most = by_depth.norm(dim=1) + by_shape.norm(dim=1)
    seen = pixels[:, 0] > settings.least_pixels
    return Normals(
        vectors=torch.where(joined.norm(dim=1, keepdim=True) > 1e-6, _normalize(joined, dim=1), neighbours.vectors),
        confidence=torch.where(seen, joined.norm(dim=1) / most.clamp_min(1e-9), neighbours.confidence),
        seen=seen | neighbours.seen,
    )


def _inverse_depth(gaussians: Gaussians, view: ObjectView, settings: DepthNormalSettings) -> Float[Tensor, "h w"]:
    """Mean inverse depth given a hit; 0 where the object is not."""
    pose = view.camera.camera_from_world[0]
    depth = (gaussians.means @ pose[:3, :3].T + pose[:3, 3])[:, 2:3]
    alpha = view.operator.alpha
    mean = view.operator.blend(1 / depth.clamp_min(1e-9))[..., 0] / alpha.clamp_min(1e-6)
    return torch.where(alpha > settings.covered, mean, torch.zeros(()))


def _normals_of(
    inverse: Float[Tensor, "h w"], view: ObjectView, radius: float, settings: DepthNormalSettings
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """World normals towards the camera by weighted least squares over windows, and their weight: cosine to the view."""
    h, w = inverse.shape
    reach = settings.reach
    steps = torch.arange(-reach, reach + 1.0)
    down, across = (s.reshape(-1, 1) for s in torch.meshgrid(steps, steps, indexing="ij"))
    gauss = torch.exp(-(across**2 + down**2) / (2 * settings.window**2))
    # rows: pixels of the window; columns: its middle
    values = torch.nn.functional.unfold(inverse[None, None], 2 * reach + 1, padding=reach)[0]
    middle = inverse.reshape(1, -1)
    depth = 1 / middle.clamp_min(1e-9)
    off = (values - middle) * depth * depth / (settings.same_surface * radius)
    weight = gauss * (values > 0) * (middle > 0) * torch.exp(-0.5 * off**2)
    sum_ = weight.sum(0).clamp_min(1e-9)

    def mean(term: Tensor) -> Tensor:
        return (weight * term).sum(0) / sum_

    x, y, v = mean(across), mean(down), mean(values)
    xx, yy, xy = mean(across**2) - x * x, mean(down**2) - y * y, mean(across * down) - x * y
    xv, yv = mean(across * values) - x * v, mean(down * values) - y * v
    determinant = (xx * yy - xy * xy).clamp_min(1e-4)
    slope_x, slope_y = (xv * yy - yv * xy) / determinant, (yv * xx - xv * xy) / determinant
    row, column = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    row, column = row.reshape(-1), column.reshape(-1)
    offset = v - slope_x * (column + x) - slope_y * (row + y)
    # on a plane n . p = d the inverse depth is (n / d) . ((u - cx) / fx, (v - cy) / fy, 1)
    k = view.camera.intrinsics[0]
    plane = torch.stack([slope_x * k[0, 0], slope_y * k[1, 1], offset + slope_x * k[0, 2] + slope_y * k[1, 2]], 1)
    normal = -_normalize(plane, dim=1)
    ray = torch.stack([(column - k[0, 2]) / k[0, 0], (row - k[1, 2]) / k[1, 1], torch.ones_like(row)], 1)
    cosine = -(normal * _normalize(ray, dim=1)).sum(1).clamp_max(0)
    used = cosine * (sum_ > settings.least_filled * gauss.sum())
    world = normal @ view.camera.camera_from_world[0, :3, :3]
    return world.reshape(h, w, 3), used.reshape(h, w, 1)
