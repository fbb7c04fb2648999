"""Turns a capture upright by its cameras and sparse points. Knows nothing about images or files."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.orbit import estimate_up
from splatgraft.similarity import Similarity

_TILT_DEG = 25.0
_SHARE = 0.2
_TRIALS = 2000


def dominant_plane(
    points: Float[Tensor, "m 3"], up: Float[Tensor, "3"], seed: int = 0
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]] | None:
    """Unit normal n and offset d (n . x = d) of the largest nearly level plane, or None where no plane is clear.

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
    return normal.to(points), offset.to(points)


def upright(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Similarity:
    """upright_from_world: +z up, the support plane at z = 0 where one is clear, the median point above the origin.

    The median distance of the cameras from the median point becomes 1, since structure from motion knows no scale.
    """
    up = estimate_up(cameras)
    plane = dominant_plane(points, up)
    up = up if plane is None else plane[0]
    middle = points.median(0).values if len(points) else cameras.centers.mean(0)
    height = up @ middle if plane is None else plane[1]
    distance = (cameras.centers - middle).norm(dim=1).median()
    scale = float(1 / distance) if distance > 0 else 1.0
    rotation = _z_from(up)
    return Similarity(
        scale=scale, rotation=rotation, translation=-scale * (rotation @ (middle + up * (height - up @ middle)))
    )


def _z_from(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """A rotation that takes `up` to +z."""
    side = torch.eye(3).to(up)[int(up.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(side, up), dim=0)
    return torch.stack([x, torch.linalg.cross(up, x), up])
