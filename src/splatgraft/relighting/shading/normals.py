"""Surface normals of Gaussians, with a confidence. Knows nothing about light or images.

A Gaussian and its neighbours together are a mixture; the shortest axis of the mixture's covariance is the normal. It
joins each one's own shortest axis, its neighbours' axes and how they lie, and stays defined where Gaussians are round.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit, prange
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shading.nearest_neighbours import nearest_neighbours
from splatgraft.relighting.shadows.camera_visibility import seen_from, spread_over
from splatgraft.runtime.kernel_lock import serialized

NEIGHBOURS = 16
_VIEWERS = 8


@dataclass(frozen=True)
class Normals:
    """Per Gaussian, where its surface looks."""

    vectors: Float[Tensor, "n 3"]
    """Unit, world frame, towards the cameras."""
    confidence: Float[Tensor, "n"]
    """0 where neighbours are a round cloud or face different ways, 1 on a plane."""
    seen: Bool[Tensor, "n"]
    """Whether some camera sees it, not behind others: what none sees was never given its true colour."""


def estimate_normals(gaussians: Gaussians, cameras: Cameras, *, among: Gaussians | None = None) -> Normals:
    """Normals turned towards the cameras that see each Gaussian, not behind others; less sure where none does.

    `among` are the others that may hide it; they are itself where none are given.
    """
    n = gaussians.count
    if n == 0:
        return Normals(vectors=torch.zeros(0, 3), confidence=torch.zeros(0), seen=torch.zeros(0, dtype=torch.bool))
    neighbours = nearest_neighbours(gaussians.means, count=NEIGHBOURS).numpy()
    cloud = (gaussians.means.numpy(), gaussians.covariances.numpy(), gaussians.opacities.numpy())
    towards, seen = _towards_viewers(gaussians, cameras, gaussians if among is None else among)
    out = np.zeros((n, 4), np.float32)
    _estimate(cloud, neighbours, towards.numpy(), out)
    result = torch.from_numpy(_agree(out, neighbours))
    confidence = result[:, 3] * torch.where(seen, 1.0, 0.5)
    return Normals(vectors=result[:, :3].contiguous(), confidence=confidence, seen=seen)


def raised(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Where the surface is seen: a Gaussian's own thickness above its centre."""
    half = torch.einsum("nij,ni->nj", gaussians.rotations, normals) * gaussians.scales
    return gaussians.means + 1.5 * half.norm(dim=1, keepdim=True) * normals


def _towards_viewers(
    gaussians: Gaussians, cameras: Cameras, among: Gaussians
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Sum of unit vectors to the cameras that see each Gaussian (to all, where none does), and whether any does."""
    total = np.zeros((2, gaussians.count, 3), np.float32)
    for i in spread_over(cameras, count=_VIEWERS):
        _look(
            gaussians.means.numpy(),
            cameras[i].centers[0].numpy(),
            seen_from(gaussians, cameras[i], among=among).numpy(),
            total,
        )
    by_viewers, everyone = torch.from_numpy(total)
    seen_at_all = by_viewers.norm(dim=1) > 0
    return torch.where(seen_at_all[:, None], by_viewers, everyone), seen_at_all


@serialized
@njit(cache=True, parallel=True)
@no_type_check
def _look(means, center, seen, total):
    """Add the unit vector to a camera where a Gaussian is seen (first plane), and everywhere (second plane)."""
    for i in prange(len(means)):
        x, y, z = center[0] - means[i, 0], center[1] - means[i, 1], center[2] - means[i, 2]
        length = np.float32(np.sqrt(x * x + y * y + z * z)) + np.float32(1e-12)
        for plane in range(0 if seen[i] else 1, 2):
            total[plane, i, 0] += x / length
            total[plane, i, 1] += y / length
            total[plane, i, 2] += z / length


@njit(cache=True, inline="always")
@no_type_check
def _shortest_axis(xx, xy, xz, yy, yz, zz):
    """Unit eigenvector of the smallest eigenvalue of a symmetric matrix, and how much shorter it is than the next."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    p = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if p < 1e-12:
        return 0.0, 0.0, 1.0, 0.0
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(min(1.0, max(-1.0, determinant / (2 * p**3)))) / 3
    smallest = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - smallest - (mean + 2 * p * np.cos(angle))
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    # the eigenvector is across any two rows; of the three products the longest is the surest
    best_x, best_y, best_z, longest = 0.0, 0.0, 1.0, 0.0
    for r in range(3):
        if r == 0:
            x, y, z = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
        elif r == 1:
            x, y, z = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
        else:
            x, y, z = yz * xz - c * xy, c * a - xz * xz, xz * xy - yz * a
        length = x * x + y * y + z * z
        if length > longest:
            longest = length
            best_x, best_y, best_z = x, y, z
    length = np.sqrt(best_x * best_x + best_y * best_y + best_z * best_z)
    flatness = 1.0 - np.sqrt(max(smallest, 0.0) / max(middle, 1e-12))
    return best_x / length, best_y / length, best_z / length, flatness


@serialized
@njit(cache=True, parallel=True)
@no_type_check
def _estimate(cloud, neighbours, towards, out):
    means, covariances, opacities = cloud
    for i in prange(len(means)):
        # places from the point itself: squares of world coordinates would lose digits
        total, cx, cy, cz = 1e-12, 0.0, 0.0, 0.0
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in neighbours[i]:
            w = float(opacities[j])
            x, y, z = means[j, 0] - means[i, 0], means[j, 1] - means[i, 1], means[j, 2] - means[i, 2]
            total += w
            cx, cy, cz = cx + w * x, cy + w * y, cz + w * z
            c = covariances[j]
            xx, xy, xz = xx + w * (c[0, 0] + x * x), xy + w * (c[0, 1] + x * y), xz + w * (c[0, 2] + x * z)
            yy, yz, zz = yy + w * (c[1, 1] + y * y), yz + w * (c[1, 2] + y * z), zz + w * (c[2, 2] + z * z)
        cx, cy, cz = cx / total, cy / total, cz / total
        xx, xy, xz = xx / total - cx * cx, xy / total - cx * cy, xz / total - cx * cz
        yy, yz, zz = yy / total - cy * cy, yz / total - cy * cz, zz / total - cz * cz
        own = covariances[i]
        scale = 1 / (xx + yy + zz + 1e-30)
        own_scale = 0.5 / (float(own[0, 0]) + own[1, 1] + own[2, 2] + 1e-30)
        x, y, z, flatness = _shortest_axis(
            scale * xx + own_scale * own[0, 0],
            scale * xy + own_scale * own[0, 1],
            scale * xz + own_scale * own[0, 2],
            scale * yy + own_scale * own[1, 1],
            scale * yz + own_scale * own[1, 2],
            scale * zz + own_scale * own[2, 2],
        )
        if x * towards[i, 0] + y * towards[i, 1] + z * towards[i, 2] < 0:
            x, y, z = -x, -y, -z
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
        # twice as wide as thick is a surface
        out[i, 3] = min(1.0, max(0.0, 2 * flatness))


@serialized
@njit(cache=True, parallel=True)
@no_type_check
def _agree(normals, neighbours):
    """Average over neighbours, weighted by confidence; the length of the average says how far they agree."""
    out = np.zeros_like(normals)
    for i in prange(len(normals)):
        x, y, z, weight = 0.0, 0.0, 0.0, 0.0
        for j in neighbours[i]:
            w = normals[j, 3] + 1e-3
            x += w * normals[j, 0]
            y += w * normals[j, 1]
            z += w * normals[j, 2]
            weight += w
        length = np.sqrt(x * x + y * y + z * z)
        agreement = length / weight
        if length < 1e-6:
            out[i, :3] = normals[i, :3]
            continue
        out[i, 0], out[i, 1], out[i, 2] = x / length, y / length, z / length
        out[i, 3] = np.sqrt(normals[i, 3] * weight / len(neighbours[i])) * max(0.0, 2 * agreement - 1)
    return out
