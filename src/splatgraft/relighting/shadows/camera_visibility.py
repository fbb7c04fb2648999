"""Which Gaussians a camera sees unoccluded: their centres compared with a small depth image."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool
from numba import prange
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render
from splatgraft.runtime.kernels import kernel, serialized

# set by hand
_WIDTH = 128
"""Pixels; width of the depth image."""
_SURFACE_ALPHA = 0.5
"""A pixel of at least this alpha shows a surface."""
_DEPTH_TOLERANCE = np.float32(0.005)
"""Share of its depth by which a Gaussian may lie behind the surface."""
_BEHIND = 2
"""Standard deviations by which it may lie behind, besides."""


def spread_over(cameras: Cameras, *, count: int) -> list[int]:
    """At most `count` cameras, evenly over the list."""
    last = len(cameras) - 1
    return sorted({round(j * last / max(count - 1, 1)) for j in range(min(count, len(cameras)))})


def seen_from(gaussians: Gaussians, camera: Cameras, *, among: Gaussians) -> Bool[Tensor, "n"]:
    """Whether one camera sees each Gaussian's centre.

    Args:
        gaussians: The n Gaussians that are tested.
        camera: A single camera.
        among: All Gaussians that may occlude them.
    """
    small = camera.resized(_WIDTH / int(camera.sizes[0, 0]))
    rendered = render(among, small, outputs=frozenset({"depth"}))
    surface = torch.where(rendered.alpha[0] > _SURFACE_ALPHA, rendered.depth[0], torch.inf).numpy()
    pose, intrinsics = small.camera_from_world[0].numpy(), small.intrinsics[0].numpy()
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
