"""Which Gaussians a person means: a box in space, a rectangle of the picture, a brush. Knows nothing about browsers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians

_REACH = 3.0
"""Standard deviations beyond which a Gaussian stops nothing."""


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
    """Where a ray meets what the picture shows: where half of the light is stopped; None where it never is.

    Each Gaussian stops its share at the point of the ray where it is densest (3DGS, Eq. 3, along a ray).
    """
    direction = torch.nn.functional.normalize(direction, dim=0).double()
    offset = gaussians.means.double() - origin.double()
    beside = (offset - (offset @ direction)[:, None] * direction).norm(dim=1)
    near = beside < _REACH * gaussians.scales.amax(1)
    covariances = gaussians.select(near).covariances.double()
    # a thousandth of the largest axis keeps needles and discs invertible
    floor = 1e-6 * covariances.diagonal(dim1=1, dim2=2).sum(1)
    inverse = torch.linalg.inv(covariances + floor[:, None, None] * torch.eye(3, dtype=torch.float64))
    forward = torch.einsum("i,nij->nj", direction, inverse)
    depth = (forward * offset[near]).sum(1) / (forward @ direction)
    rest = offset[near] - depth[:, None] * direction
    alpha = gaussians.opacities[near] * torch.exp(-0.5 * torch.einsum("ni,nij,nj->n", rest, inverse, rest))
    depth, alpha = depth[depth > 0], alpha[depth > 0]
    order = depth.argsort()
    stopped = 1 - (1 - alpha[order]).cumprod(0) > 0.5
    return origin + float(depth[order][stopped][0]) * direction.to(origin) if bool(stopped.any()) else None


def in_brush(gaussians: Gaussians, centre: Float[Tensor, "3"], radius: float) -> Bool[Tensor, "n"]:
    """Which Gaussians a brush's ball reaches: by their middle size, but none whose centre is two radii away.

    A narrow brush would else slip between the centres of wide Gaussians, and a wide one take the backdrop.
    """
    reach = gaussians.scales.median(1).values.clamp_max(radius)
    return (gaussians.means - centre).norm(dim=1) <= radius + reach


@dataclass(frozen=True)
class Ray:
    """Where a person points."""

    origin: Float[Tensor, "3"]
    """The eye."""
    direction: Float[Tensor, "3"]
    """Of any length."""


def painted(gaussians: Gaussians, rays: Sequence[Ray], *, size: float) -> Bool[Tensor, "n"]:
    """Which Gaussians a stroke takes: a ball around each hit, `size` of its distance wide."""
    touched = torch.zeros(gaussians.count, dtype=torch.bool)
    for ray in rays:
        hit = first_hit(gaussians, ray.origin, ray.direction)
        if hit is not None:
            touched |= in_brush(gaussians, hit, 0.5 * size * float((hit - ray.origin).norm()))
    return touched


def between(start: Ray, end: Ray, *, size: float) -> list[Ray]:
    """Rays from after `start` up to `end`, a quarter of the brush apart, so that a quick stroke has no gaps."""
    a, b = (torch.nn.functional.normalize(ray.direction, dim=0) for ray in (start, end))
    count = max(1, math.ceil(float((b - a).norm()) / (0.25 * size)))
    return [Ray(end.origin, a + (b - a) * (step + 1) / count) for step in range(count)]
