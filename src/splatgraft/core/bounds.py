"""The bounding sphere of Gaussians, robust to stray ones."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians


@dataclass(frozen=True)
class BoundingSphere:
    """Where an object is: the ball that holds all but its stray Gaussians."""

    center: Float[Tensor, "3"]
    radius: float


def bounding_sphere(gaussians: Gaussians) -> BoundingSphere:
    """The ball around the opacity-weighted middle that holds 99% of the opaque Gaussians and their width."""
    opaque = gaussians.opacities > 0.1
    means = gaussians.means[opaque] if bool(opaque.any()) else gaussians.means
    scales = (gaussians.scales[opaque] if bool(opaque.any()) else gaussians.scales).max(1).values
    # parted, not sorted, as quantiles are: this is asked of every object at every move
    few, most = round(0.01 * (len(means) - 1)), round(0.99 * (len(means) - 1))
    parted = torch.from_numpy(np.partition(means.numpy(), (few, most), axis=0))
    center = 0.5 * (parted[few] + parted[most])
    reach = (means - center).norm(dim=1) + scales
    return BoundingSphere(center=center, radius=1.05 * float(np.partition(reach.numpy(), most)[most]))
