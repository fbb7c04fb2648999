"""The bounding sphere of an object's Gaussians, from percentiles, so that stray Gaussians do not enlarge it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians

_STRAY = 0.01  # share of Gaussians on either side that may lie outside; like the others below, set by hand


@dataclass(frozen=True)
class BoundingSphere:
    """A sphere around an object's Gaussians."""

    center: Float[Tensor, "3"]
    """Centre, world units, in the frame of the Gaussians."""
    radius: float
    """Radius, world units."""


def bounding_sphere(gaussians: Gaussians) -> BoundingSphere:
    """Compute the sphere that holds 99% of the opaque Gaussians with one standard deviation of their width, plus 5%.

    Its centre is the middle between the 1st and the 99th percentile along each axis. Gaussians below an opacity of 0.1
    are ignored, unless all are.
    """
    opaque = gaussians.opacities > 0.1
    means = gaussians.means[opaque] if bool(opaque.any()) else gaussians.means
    scales = (gaussians.scales[opaque] if bool(opaque.any()) else gaussians.scales).max(1).values
    # a partition is faster than a quantile's sort; the editor computes this after every move
    low, high = round(_STRAY * (len(means) - 1)), round((1 - _STRAY) * (len(means) - 1))
    partitioned = torch.from_numpy(np.partition(means.numpy(), (low, high), axis=0))
    center = 0.5 * (partitioned[low] + partitioned[high])
    reach = (means - center).norm(dim=1) + scales
    return BoundingSphere(center=center, radius=1.05 * float(np.partition(reach.numpy(), high)[high]))
