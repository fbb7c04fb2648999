"""Planes through point clouds: random samples of three points, least squares, and the largest nearly level plane.

The level plane is found by RANSAC (Fischler and Bolles 1981) among planes that are nearly perpendicular to the given
up, then fitted to its inliers. It is a floor or a table.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class LevelPlaneOptions:
    """Criteria of a clear level plane, set by hand."""

    tilt_deg: float = 25.0
    """Largest angle between the plane's normal and the given up."""
    inlier_share: float = 0.2
    """Minimum share of all points that lie on the plane."""
    thickness: float = 0.01
    """Largest distance of an inlier, over the median distance of the points from their median."""


@dataclass(frozen=True)
class LevelPlane:
    """Points x with normal . x = offset."""

    normal: Float[Tensor, "3"]
    """Unit normal that points upwards."""
    offset: float
    """Distance from the world's origin along the normal, world units."""
    thickness: float
    """Largest distance of an inlier, world units."""

    def height(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Compute the signed distance above the plane, world units."""
        return points @ self.normal.to(points) - self.offset


def sample_planes(
    points: Float[Tensor, "m 3"], trials: int, *, seed: int
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """Sample planes through three random points; returns normals, of twice the triangle's area, and a point on each."""
    generator = torch.Generator().manual_seed(seed)
    corners = points[torch.randint(len(points), (trials, 3), generator=generator)]
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners[:, 0]


def least_squares_normal(offsets: Float[Tensor, "m 3"]) -> Float[Tensor, "3"]:
    """Fit a plane through the origin to `offsets`; returns its unit normal, of either sign, in float64."""
    return torch.linalg.eigh(offsets.double().T @ offsets.double()).eigenvectors[:, 0]


def dominant_level_plane(
    points: Float[Tensor, "m 3"], up: Float[Tensor, "3"], *, options: LevelPlaneOptions = LevelPlaneOptions()
) -> LevelPlane | None:
    """Find the largest nearly level plane among sparse surface points; None if no plane is level and large enough."""
    x, upward = points.double(), up.double()
    if len(x) < 50:
        return None
    threshold = options.thickness * (x - x.median(0).values).norm(dim=1).median()
    normals, on_plane = sample_planes(x, 2000, seed=0)
    normals = torch.nn.functional.normalize(normals, dim=1)
    normals = normals * torch.sign(normals @ upward)[:, None]
    level = normals @ upward > math.cos(math.radians(options.tilt_deg))
    if not level.any():
        return None
    normals, offsets = normals[level], (normals[level] * on_plane[level]).sum(1)
    counts = torch.stack([((x @ n - d).abs() < threshold).sum() for n, d in zip(normals, offsets, strict=True)])
    normal, offset = normals[counts.argmax()], offsets[counts.argmax()]
    for _ in range(3):  # least-squares fits, each to the inliers of the one before
        inliers = x[(x @ normal - offset).abs() < threshold]
        if len(inliers) < options.inlier_share * len(x):
            return None
        middle = inliers.mean(0)
        axis = least_squares_normal(inliers - middle)
        normal = axis * torch.sign(axis @ upward)
        offset = normal @ middle
    return LevelPlane(normal.to(points), float(offset), float(threshold))
