"""Surface normals of Gaussians, with a confidence. Knows nothing about light or images.

A Gaussian and its neighbours together are a mixture; the shortest axis of the mixture's covariance is the normal. It
joins each one's own shortest axis, its neighbours' axes and how they lie, and stays defined where Gaussians are round.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from scipy.spatial import cKDTree
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.gaussians import Gaussians

NEIGHBOURS = 16


@dataclass(frozen=True)
class Normals:
    """Per Gaussian, where its surface looks."""

    vectors: Float[Tensor, "n 3"]
    """Unit, world frame, towards the cameras."""
    confidence: Float[Tensor, "n"]
    """0 where neighbours are a round cloud or face different ways, 1 on a plane."""


def estimate_normals(gaussians: Gaussians, cameras: Cameras) -> Normals:
    """Normals turned towards the cameras that have each Gaussian in view; confidence 0 where none has."""
    n = gaussians.count
    if n == 0:
        return Normals(vectors=torch.zeros(0, 3), confidence=torch.zeros(0))
    means = gaussians.means.double().numpy()
    k = min(NEIGHBOURS, n)
    _, neighbours = cKDTree(means, balanced_tree=False, compact_nodes=False).query(means, k=k, workers=2)
    poses = cameras.camera_from_world.double().numpy()
    focal = (torch.stack([cameras.intrinsics[:, 0, 0], cameras.intrinsics[:, 1, 1]], 1) / cameras.sizes).double()
    out = np.zeros((n, 4), np.float32)
    _estimate(
        (means, gaussians.covariances.double().numpy(), gaussians.opacities.double().numpy()),
        neighbours.reshape(n, k).astype(np.int32),
        (poses, focal.numpy().reshape(-1, 2)),
        out,
    )
    smooth = _agree(out, neighbours.reshape(n, k).astype(np.int32))
    result = torch.from_numpy(smooth)
    return Normals(vectors=result[:, :3].contiguous(), confidence=result[:, 3].contiguous())


@njit(cache=True)
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
def _estimate(cloud, neighbours, views, out):
    means, covariances, opacities = cloud
    poses, focal = views
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
            # a neighbour much larger than the neighbourhood says nothing about its place
            for r in range(3):
                for c in range(3):
                    mixture[r, c] += weight * (covariances[j, r, c] + away[r] * away[c])
        own = covariances[i]
        scale = mixture[0, 0] + mixture[1, 1] + mixture[2, 2] + 1e-30
        own_scale = own[0, 0] + own[1, 1] + own[2, 2] + 1e-30
        normal, flatness = _shortest_axis(mixture / scale + 0.5 * own / own_scale)
        towards = 0.0
        seen = 0
        for v in range(len(poses)):
            p = poses[v]
            x = p[0, 0] * means[i, 0] + p[0, 1] * means[i, 1] + p[0, 2] * means[i, 2] + p[0, 3]
            y = p[1, 0] * means[i, 0] + p[1, 1] * means[i, 1] + p[1, 2] * means[i, 2] + p[1, 3]
            z = p[2, 0] * means[i, 0] + p[2, 1] * means[i, 1] + p[2, 2] * means[i, 2] + p[2, 3]
            if z > 0 and abs(x / z) * focal[v, 0] < 0.5 and abs(y / z) * focal[v, 1] < 0.5:
                nx = p[0, 0] * normal[0] + p[0, 1] * normal[1] + p[0, 2] * normal[2]
                ny = p[1, 0] * normal[0] + p[1, 1] * normal[1] + p[1, 2] * normal[2]
                nz = p[2, 0] * normal[0] + p[2, 1] * normal[1] + p[2, 2] * normal[2]
                towards -= (nx * x + ny * y + nz * z) / np.sqrt(x * x + y * y + z * z)
                seen += 1
        if seen == 0:
            flatness = 0.0
        if towards < 0:
            normal = -normal
        out[i, 0], out[i, 1], out[i, 2] = normal[0], normal[1], normal[2]
        out[i, 3] = min(1.0, max(0.0, flatness))


@njit(cache=True, parallel=True)
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
