"""Selection of Gaussians by a rectangle in the image, by ray casting, and by a brush."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians

_CUTOFF_SIGMAS = 3.0
"""Distance from its centre, in standard deviations, beyond which a Gaussian does not occlude a ray."""


def in_rectangle(
    means: Float[Tensor, "n 3"], camera: Cameras, corner: tuple[float, float], opposite: tuple[float, float]
) -> Bool[Tensor, "n"]:
    """Flag the centres that project into a rectangle of one camera's image, even occluded ones.

    Its corners are x and y over the image's width and height.
    """
    pixels, depth = camera.project(means)
    share, corners = pixels / camera.sizes[0].to(means), torch.tensor([corner, opposite])
    inside = (share >= corners.amin(0)) & (share <= corners.amax(0))
    return inside.all(1) & (depth > 0)


def first_surface_hit(
    gaussians: Gaussians, origin: Float[Tensor, "3"], direction: Float[Tensor, "3"]
) -> Float[Tensor, "3"] | None:
    """Find the point on a ray where accumulated opacity exceeds one half; None if it never does.

    Each Gaussian contributes its opacity at the point of the ray where its density is largest (3DGS, Eq. 3).
    """
    direction = torch.nn.functional.normalize(direction, dim=0).double()
    offset = gaussians.means.double() - origin.double()
    distance = (offset - (offset @ direction)[:, None] * direction).norm(dim=1)
    near = distance < _CUTOFF_SIGMAS * gaussians.scales.amax(1)
    covariances = gaussians.select(near).covariances.double()
    # regularised by a thousandth of the root trace, so that flat covariances are invertible
    floor = 1e-6 * covariances.diagonal(dim1=1, dim2=2).sum(1)
    inverse = torch.linalg.inv(covariances + floor[:, None, None] * torch.eye(3, dtype=torch.float64))
    forward = torch.einsum("i,nij->nj", direction, inverse)
    depth = (forward * offset[near]).sum(1) / (forward @ direction)
    rest = offset[near] - depth[:, None] * direction
    alpha = gaussians.opacities[near] * torch.exp(-0.5 * torch.einsum("ni,nij,nj->n", rest, inverse, rest))
    depth, alpha = depth[depth > 0], alpha[depth > 0]
    order = depth.argsort()
    occluded = 1 - (1 - alpha[order]).cumprod(0) > 0.5
    return origin + float(depth[order][occluded][0]) * direction.to(origin) if bool(occluded.any()) else None


def in_brush(gaussians: Gaussians, centre: Float[Tensor, "3"], radius: float) -> Bool[Tensor, "n"]:
    """Flag the Gaussians that a spherical brush touches.

    A Gaussian counts as a ball with its median scale as radius, at most the brush's radius. A narrow brush then does
    not miss wide Gaussians between their centres, and a wide brush does not select the background.
    """
    extent = gaussians.scales.median(1).values.clamp_max(radius)
    return (gaussians.means - centre).norm(dim=1) <= radius + extent


@dataclass(frozen=True)
class Ray:
    """A ray from the camera through the pointer."""

    origin: Float[Tensor, "3"]
    """Camera centre, world units."""
    direction: Float[Tensor, "3"]
    """Direction, of any length."""

    @staticmethod
    def through(place: tuple[float, float], camera: Cameras) -> "Ray":
        """Return the ray through a position over the canvas's sides, with a direction of depth 1."""
        k, pose = camera.intrinsics[0], camera.world_from_camera[0]
        pixel = torch.tensor([place[0] * camera.width, place[1] * camera.height, 1.0])
        return Ray(pose[:3, 3], pose[:3, :3] @ (torch.linalg.inv(k) @ pixel))


def brush_selection(gaussians: Gaussians, rays: Sequence[Ray], *, size: float) -> Bool[Tensor, "n"]:
    """Flag the Gaussians in a stroke; `size` is the diameter of the brush over the distance of the hit point."""
    selected = torch.zeros(gaussians.count, dtype=torch.bool)
    for ray in rays:
        hit = first_surface_hit(gaussians, ray.origin, ray.direction)
        if hit is not None:
            selected |= in_brush(gaussians, hit, 0.5 * size * float((hit - ray.origin).norm()))
    return selected


def interpolate_rays(start: Ray, end: Ray, *, size: float) -> list[Ray]:
    """Return rays after `start` up to `end`, at most a quarter of the brush's diameter `size` apart."""
    a, b = (torch.nn.functional.normalize(ray.direction, dim=0) for ray in (start, end))
    count = max(1, math.ceil(float((b - a).norm()) / (0.25 * size)))
    return [Ray(end.origin, a + (b - a) * (step + 1) / count) for step in range(count)]
