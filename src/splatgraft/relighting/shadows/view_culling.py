"""Which Gaussians may be seen in a camera's picture, and how wide they are there: a numba kernel."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.runtime.kernels import kernel, serialized

_REACH = np.float32(3)
"""Standard deviations by which a Gaussian's centre may lie outside the picture."""
_NEAREST = np.float32(1e-6)
"""World units; a depth below is taken for this one."""


def gaussians_in_view(
    means: Float[Tensor, "n 3"], widths: Float[Tensor, "n"], camera: Cameras
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Positions of the Gaussians that the camera may show, ascending, and their standard deviations in pixels.

    Args:
        means: World units.
        widths: Largest standard deviations, world units.
        camera: One.
    """
    drawn = np.empty(len(means), np.float32)
    pose, intrinsics = (
        np.ascontiguousarray(x[0].numpy(), np.float32) for x in (camera.camera_from_world, camera.intrinsics)
    )
    size = camera.sizes[0].float().numpy()
    _drawn_widths(means.contiguous().numpy(), widths.contiguous().numpy(), pose, intrinsics, size, drawn)
    which = torch.from_numpy(np.nonzero(drawn >= 0)[0])
    return which, torch.from_numpy(drawn)[which]


@serialized
@kernel(parallel=True)
@no_type_check
def _drawn_widths(means, widths, pose, intrinsics, size, drawn):
    """Fill `drawn` with standard deviations in pixels; -1 for what lies outside the picture."""
    for i in prange(means.shape[0]):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        a = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        b = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        over = np.float32(1) / max(intrinsics[2, 0] * a + intrinsics[2, 1] * b + intrinsics[2, 2] * depth, _NEAREST)
        u = (intrinsics[0, 0] * a + intrinsics[0, 1] * b + intrinsics[0, 2] * depth) * over
        v = (intrinsics[1, 0] * a + intrinsics[1, 1] * b + intrinsics[1, 2] * depth) * over
        width = widths[i] * intrinsics[0, 0] / max(depth, _NEAREST)
        beside = _REACH * width
        inside = depth > 0 and u > -beside and v > -beside and u < size[0] + beside and v < size[1] + beside
        drawn[i] = width if inside else np.float32(-1)
