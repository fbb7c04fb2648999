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
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.gaussians import Gaussians
from splatgraft.rendering import render

NEIGHBOURS = 16
_VIEWERS, _VIEWER_WIDTH = 8, 128


@dataclass(frozen=True)
class Normals:
    """Per Gaussian, where its surface looks."""

    vectors: Float[Tensor, "n 3"]
    """Unit, world frame, towards the cameras."""
    confidence: Float[Tensor, "n"]
    """0 where neighbours are a round cloud or face different ways, 1 on a plane."""
    seen: Bool[Tensor, "n"]
    """Whether some camera sees it, not behind others: what none sees was never given its true colour."""


def estimate_normals(gaussians: Gaussians, cameras: Cameras) -> Normals:
    """Normals turned towards the cameras that see each Gaussian, not behind others; less sure where none does."""
    n = gaussians.count
    if n == 0:
        return Normals(vectors=torch.zeros(0, 3), confidence=torch.zeros(0), seen=torch.zeros(0, dtype=torch.bool))
    means = gaussians.means.double().numpy()
    k = min(NEIGHBOURS, n)
    _, neighbours = KDTree(means, balanced_tree=False, compact_nodes=False).query(means, k=k, workers=2)
    neighbours = neighbours.reshape(n, k).astype(np.int32)
    cloud = (means, gaussians.covariances.double().numpy(), gaussians.opacities.double().numpy())
    towards, seen = _towards_viewers(gaussians, cameras)
    out = np.zeros((n, 4), np.float32)
    _estimate(cloud, neighbours, towards.double().numpy(), out)
    result = torch.from_numpy(_agree(out, neighbours))
    confidence = result[:, 3] * torch.where(seen, 1.0, 0.5)
    return Normals(vectors=result[:, :3].contiguous(), confidence=confidence, seen=seen)


def raised(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Where the surface is seen: a Gaussian's own thickness above its centre."""
    half = torch.einsum("nij,ni->nj", gaussians.rotations, normals) * gaussians.scales
    return gaussians.means + 1.5 * half.norm(dim=1, keepdim=True) * normals


def _towards_viewers(gaussians: Gaussians, cameras: Cameras) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Sum of unit vectors to the cameras that see each Gaussian (to all, where none does), and whether any does."""
    total = np.zeros((2, gaussians.count, 3), np.float32)
    means, widths = gaussians.means.numpy(), gaussians.scales.mean(1).numpy()
    count = len(cameras)
    for i in sorted({round(j * (count - 1) / max(_VIEWERS - 1, 1)) for j in range(min(_VIEWERS, count))}):
        camera = cameras[i].resized(_VIEWER_WIDTH / int(cameras.sizes[i, 0]))
        seen = render(gaussians, camera, outputs=frozenset({"depth"}))
        assert seen.depth is not None
        surface = torch.where(seen.alpha[0] > 0.5, seen.depth[0], torch.inf).numpy()
        pose, center = camera.camera_from_world[0].numpy(), camera.centers[0].numpy()
        _look(means, widths, (pose, camera.intrinsics[0].numpy(), center), surface, total)
    by_viewers, everyone = torch.from_numpy(total)
    seen_at_all = by_viewers.norm(dim=1) > 0
    return torch.where(seen_at_all[:, None], by_viewers, everyone), seen_at_all


@njit(cache=True, parallel=True)
@no_type_check
def _look(means, widths, camera, surface, total):
    """Add the unit vector to `camera` where a Gaussian is seen (first plane), and everywhere (second plane)."""
    pose, intrinsics, center = camera
    height, width = surface.shape
    for i in prange(len(means)):
        x, y, z = center[0] - means[i, 0], center[1] - means[i, 1], center[2] - means[i, 2]
        length = np.float32(np.sqrt(x * x + y * y + z * z)) + np.float32(1e-12)
        total[1, i, 0] += x / length
        total[1, i, 1] += y / length
        total[1, i, 2] += z / length
        depth = -(pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z)
        if depth <= 0:
            continue
        u = -(pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z) / depth * intrinsics[0, 0] + intrinsics[0, 2]
        v = -(pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z) / depth * intrinsics[1, 1] + intrinsics[1, 2]
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        if depth < surface[int(v), int(u)] + np.float32(0.005) * depth + 2 * widths[i]:
            total[0, i, 0] += x / length
            total[0, i, 1] += y / length
            total[0, i, 2] += z / length


@njit(cache=True)
@no_type_check
def _shortest_axis(m):
    """Unit eigenvector of the smallest eigenvalue of a symmetric matrix, and how much shorter it is than the next."""
    mean = (m[0, 0] + m[1, 1] + m[2, 2]) / 3
    a, b, c = m[0, 0] - mean, m[1, 1] - mean, m[2, 2] - mean
    off = m[0, 1] ** 2 + m[0, 2] ** 2 + m[1, 2] ** 2
    p = np.sqrt((a * a + b * b + c * c + 2 * off) / 6)
    best = np.array([0.0, 0.0, 1.0])
    if p < 1e-12:
        return best, 0.0
    determinant = a * (b * c - m[1, 2] ** 2) - m[0, 1] * (m[0, 1] * c - m[1, 2] * m[0, 2])
    determinant += m[0, 2] * (m[0, 1] * m[1, 2] - b * m[0, 2])
    angle = np.arccos(min(1.0, max(-1.0, determinant / (2 * p**3)))) / 3
    smallest = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - smallest - (mean + 2 * p * np.cos(angle))
    rows = m - smallest * np.eye(3)
    longest = 0.0
    for r in range(3):
        x, y = rows[r], rows[(r + 1) % 3]
        axis = np.array([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
        length = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        if length > longest:
            longest = length
            best = axis / length
    return best, 1.0 - np.sqrt(max(smallest, 0.0) / max(middle, 1e-12))


@njit(cache=True, parallel=True)
@no_type_check
def _estimate(cloud, neighbours, towards, out):
    means, covariances, opacities = cloud
    for i in prange(len(means)):
        total = 0.0
        center = np.zeros(3)
        for j in neighbours[i]:
            total += opacities[j]
            center += opacities[j] * means[j]
        center /= max(total, 1e-12)
        mixture = np.zeros((3, 3))
        for j in neighbours[i]:
            weight = opacities[j] / max(total, 1e-12)
            away = means[j] - center
            for r in range(3):
                for c in range(3):
                    mixture[r, c] += weight * (covariances[j, r, c] + away[r] * away[c])
        own = covariances[i]
        scale = mixture[0, 0] + mixture[1, 1] + mixture[2, 2] + 1e-30
        own_scale = own[0, 0] + own[1, 1] + own[2, 2] + 1e-30
        normal, flatness = _shortest_axis(mixture / scale + 0.5 * own / own_scale)
        if normal[0] * towards[i, 0] + normal[1] * towards[i, 1] + normal[2] * towards[i, 2] < 0:
            normal = -normal
        out[i, 0], out[i, 1], out[i, 2] = normal[0], normal[1], normal[2]
        # twice as wide as thick is a surface
        out[i, 3] = min(1.0, max(0.0, 2 * flatness))


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
