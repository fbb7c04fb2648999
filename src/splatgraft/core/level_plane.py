"""The largest nearly level plane among points: a floor, a table. Knows nothing about cameras or Gaussians."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_TILT_DEG = 25.0
_SHARE = 0.2
_TRIALS = 2000


@dataclass(frozen=True)
class LevelPlane:
    """All x with normal . x = offset."""

    normal: Float[Tensor, "3"]
    """Unit, upwards."""
    offset: float
    """Along the normal from the world's origin, world units."""
    thickness: float
    """How far from it a point may lie and still count as on it, world units."""

    def height(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Signed distance above it, world units."""
        return points @ self.normal.to(points) - self.offset


def dominant_level_plane(points: Float[Tensor, "m 3"], up: Float[Tensor, "3"], seed: int = 0) -> LevelPlane | None:
    """The largest nearly level plane, or None where none is clear.

    RANSAC within 25 degrees of `up`, then least squares on the inliers; clear means a fifth of all points.
    """
    x, upward = points.double(), up.double()
    if len(x) < 50:
        return None
    threshold = 0.01 * (x - x.median(0).values).norm(dim=1).median()
    generator = torch.Generator().manual_seed(seed)
    corners = x[torch.randint(len(x), (_TRIALS, 3), generator=generator)]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=1)
    normals = normals * torch.sign(normals @ upward)[:, None]
    level = normals @ upward > math.cos(math.radians(_TILT_DEG))
    if not level.any():
        return None
    normals, offsets = normals[level], (normals[level] * corners[level, 0]).sum(1)
    counts = torch.stack([((x @ n - d).abs() < threshold).sum() for n, d in zip(normals, offsets, strict=True)])
    normal, offset = normals[counts.argmax()], offsets[counts.argmax()]
    for _ in range(3):
        inliers = x[(x @ normal - offset).abs() < threshold]
        if len(inliers) < _SHARE * len(x):
            return None
        middle = inliers.mean(0)
        axis = torch.linalg.eigh((inliers - middle).T @ (inliers - middle)).eigenvectors[:, 0]
        normal = axis * torch.sign(axis @ upward)
        offset = normal @ middle
    return LevelPlane(normal.to(points), float(offset), float(threshold))
