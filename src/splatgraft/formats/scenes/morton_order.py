"""The order of points along a Morton curve, in which neighbours in a file are neighbours in space."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

_BITS = 10


def morton_order(points: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """Indices of `points` along the curve, through 1024 cells per axis whose bounds are quantiles: scenes have a few
    points far away."""
    ranks = points.argsort(dim=0, stable=True).argsort(dim=0)
    cells = ranks * (1 << _BITS) // max(1, len(points))
    code = torch.zeros(len(points), dtype=torch.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code.argsort(stable=True)
