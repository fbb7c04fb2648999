"""Surface normals of Gaussians with a confidence, turned towards the cameras that see them.

1. Find the cameras that see each Gaussian, by small depth images.
2. Compute the covariance of the mixture of each Gaussian and its nearest neighbours. Its shortest axis is the normal.
   It holds the shapes and the positions of all, so round Gaussians have a normal too.
3. Average the normals of neighbours, weighted by confidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import prange
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.nearest_neighbours import nearest_neighbours
from splatgraft.rendering import Render, render
from splatgraft.runtime.kernels import kernel, serialized

# set by hand
_NEIGHBOURS = 16  # Gaussians per mixture
_UNSEEN_CONFIDENCE = 0.5  # factor on the confidence of normals that no tested camera sees
_RAISED = 1.5  # standard deviations from a Gaussian's centre to its visible surface, along the normal
_OWN_WEIGHT = 0.5  # weight of a Gaussian's own covariance beside the mixture's, both scaled to trace 1
_FLATNESS_GAIN = 2  # confidence over (1 - thickness / width): a mixture twice as wide as thick is a surface


@dataclass(frozen=True)
class Normals:
    """Surface normals of n Gaussians."""

    vectors: Float[Tensor, "n 3"]
    """Unit normals, world frame, towards the cameras."""
    confidence: Float[Tensor, "n"]
    """Confidence in [0, 1]: 0 for neighbours that form a round cloud or disagree, 1 on a plane."""
    seen: Bool[Tensor, "n"]
    """Whether some camera sees the Gaussian unoccluded; the colours of all others were never observed."""


def estimate_normals(
    gaussians: Gaussians, cameras: Cameras, *, views: Sequence[tuple[Cameras, Render]] | None = None
) -> Normals:
    """Estimate normals towards the cameras that see each Gaussian; confidence is lower if none does.

    Args:
        gaussians: n Gaussians.
        cameras: Cameras of their capture.
        views: Single cameras with their depth of `gaussians`, to test visibility; by default 8 of `cameras`.
    """
    n = gaussians.count
    if n == 0:
        return Normals(vectors=torch.zeros(0, 3), confidence=torch.zeros(0), seen=torch.zeros(0, dtype=torch.bool))
    neighbours = nearest_neighbours(gaussians.means, count=_NEIGHBOURS).numpy()
    cloud = (gaussians.means.numpy(), gaussians.covariances.numpy(), gaussians.opacities.numpy())
    towards, seen = _towards_cameras(gaussians, _depth_views(gaussians, cameras) if views is None else views)
    out = np.zeros((n, 4), np.float32)
    _estimate(cloud, neighbours, towards.numpy(), out)
    result = torch.from_numpy(_smoothed(out, neighbours))
    confidence = result[:, 3] * torch.where(seen, 1.0, _UNSEEN_CONFIDENCE)
    return Normals(vectors=result[:, :3].contiguous(), confidence=confidence, seen=seen)


def raised(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Raise points from each Gaussian's centre to its visible side, 1.5 standard deviations along its unit normal."""
    half = torch.einsum("nij,ni->nj", gaussians.rotations, normals) * gaussians.scales
    return gaussians.means + _RAISED * half.norm(dim=1, keepdim=True) * normals


def _depth_views(gaussians: Gaussians, cameras: Cameras) -> list[tuple[Cameras, Render]]:
    small = cameras.spread(8).limited(128)  # pixels
    return [(camera, render(gaussians, camera, outputs=frozenset({"depth"}))) for camera in small]


def _towards_cameras(
    gaussians: Gaussians, views: Sequence[tuple[Cameras, Render]]
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Sum unit vectors to the cameras that see each Gaussian, or to all if none does; return also whether any does."""
    total = np.zeros((2, gaussians.count, 3), np.float32)
    for camera, drawn in views:
        seen = is_seen(gaussians, camera, drawn).numpy()
        _add_directions(gaussians.means.numpy(), camera.centers[0].numpy(), seen, total)
    to_seeing, to_all = torch.from_numpy(total)
    seen_at_all = to_seeing.norm(dim=1) > 0
    return torch.where(seen_at_all[:, None], to_seeing, to_all), seen_at_all


@serialized
@kernel(parallel=True)
@no_type_check
def _add_directions(means, center, seen, total):
    """Add the unit vectors to a camera: for visible Gaussians (first plane), and for all (second plane)."""
    for i in prange(len(means)):
        x, y, z = center[0] - means[i, 0], center[1] - means[i, 1], center[2] - means[i, 2]
        length = np.float32(np.sqrt(x * x + y * y + z * z)) + np.float32(1e-12)
        for plane in range(0 if seen[i] else 1, 2):
            total[plane, i, 0] += x / length
            total[plane, i, 1] += y / length
            total[plane, i, 2] += z / length


@kernel(inline="always")
@no_type_check
def _shortest_axis(xx, xy, xz, yy, yz, zz):
    """Compute the unit eigenvector of a symmetric matrix's smallest eigenvalue, and 1 - sqrt(smallest / middle)."""
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
    # the eigenvector is perpendicular to all rows; the longest of their cross products is the most accurate
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
@kernel(parallel=True)
@no_type_check
def _estimate(cloud, neighbours, towards, out):
    means, covariances, opacities = cloud
    for i in prange(len(means)):
        # coordinates relative to the point: squares of world coordinates would lose digits
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
        own_scale = _OWN_WEIGHT / (float(own[0, 0]) + own[1, 1] + own[2, 2] + 1e-30)
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
        out[i, 3] = min(1.0, max(0.0, _FLATNESS_GAIN * flatness))


@serialized
@kernel(parallel=True)
@no_type_check
def _smoothed(normals, neighbours):
    """Average over neighbours, weighted by confidence; a short average lowers the confidence."""
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


# set by hand
_SURFACE_ALPHA = 0.5  # smallest alpha of a pixel that shows a surface
_DEPTH_TOLERANCE = np.float32(0.005)  # share of its depth by which a visible Gaussian may lie behind the surface
_BEHIND = 2  # standard deviations that are added to this tolerance


def is_seen(gaussians: Gaussians, camera: Cameras, drawn: Render) -> Bool[Tensor, "n"]:
    """Test whether one camera sees each Gaussian's centre.

    Args:
        gaussians: The n Gaussians that are tested.
        camera: A single camera.
        drawn: Depth of all possible occluders in that camera.
    """
    surface = torch.where(drawn.alpha[0] > _SURFACE_ALPHA, drawn.depth[0], torch.inf).numpy()
    pose, intrinsics = camera.camera_from_world[0].numpy(), camera.intrinsics[0].numpy()
    out = np.zeros(gaussians.count, np.bool_)
    _compare_depths(gaussians.means.numpy(), gaussians.scales.mean(1).numpy(), (pose, intrinsics), surface, out)
    return torch.from_numpy(out)


@serialized
@kernel(parallel=True)
@no_type_check
def _compare_depths(means, widths, camera, surface, out):
    pose, intrinsics = camera
    height, width = surface.shape
    for i in prange(len(means)):
        x, y, z = means[i]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if depth <= 0:
            continue
        u = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth * intrinsics[0, 0]
        v = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth * intrinsics[1, 1]
        u, v = u + intrinsics[0, 2], v + intrinsics[1, 2]
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        out[i] = depth < surface[int(v), int(u)] + _DEPTH_TOLERANCE * depth + _BEHIND * widths[i]
