"""Which Gaussians a person means: a box in space, a rectangle of the picture, a brush. Knows nothing about browsers."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.gaussians import Gaussians

_SOLID = 0.3
"""Least opacity of what a ray stops at."""


@dataclass(frozen=True)
class Rectangle:
    """A part of the picture, in shares of its width and height from the upper left corner."""

    least: tuple[float, float]
    """Left and upper edge."""
    greatest: tuple[float, float]
    """Right and lower edge."""


def in_rectangle(means: Float[Tensor, "n 3"], camera: Cameras, rectangle: Rectangle) -> Bool[Tensor, "n"]:
    """Which centres one camera sees inside the rectangle, however far behind others."""
    pose = camera.camera_from_world[0].to(means)
    local = means @ pose[:3, :3].T + pose[:3, 3]
    pixels = (local @ camera.intrinsics[0].to(means).T)[:, :2] / local[:, 2:].clamp_min(1e-9)
    share = pixels / camera.sizes[0].to(means)
    inside = (share >= torch.tensor(rectangle.least)) & (share <= torch.tensor(rectangle.greatest))
    return inside.all(1) & (local[:, 2] > 0)


def first_hit(
    gaussians: Gaussians, origin: Float[Tensor, "3"], direction: Float[Tensor, "3"]
) -> Float[Tensor, "3"] | None:
    """Where a ray first meets something solid: the point on it beside the first Gaussian that it passes within one
    standard deviation; None where it meets nothing."""
    direction = torch.nn.functional.normalize(direction, dim=0)
    offset = gaussians.means - origin
    along = offset @ direction
    beside = offset - along[:, None] * direction
    near = (beside.norm(dim=1) < gaussians.scales.amax(1)) & (along > 0) & (gaussians.opacities > _SOLID)
    covariances = gaussians.select(near).covariances.double()
    # a thousandth of the largest axis keeps needles and discs invertible
    floor = 1e-6 * covariances.diagonal(dim1=1, dim2=2).sum(1)
    inverse = torch.linalg.inv(covariances + floor[:, None, None] * torch.eye(3, dtype=torch.float64))
    spread = torch.einsum("ni,nij,nj->n", beside[near].double(), inverse, beside[near].double())
    met = along[near][spread < 1]
    return origin + met.min() * direction if len(met) else None


def in_brush(means: Float[Tensor, "n 3"], centre: Float[Tensor, "3"], radius: float) -> Bool[Tensor, "n"]:
    """Which centres lie in the ball of a brush."""
    return (means - centre).norm(dim=1) <= radius
