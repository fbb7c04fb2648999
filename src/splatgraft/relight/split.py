"""Splits Gaussians that are too wide to hold a shadow's edge into five along an axis, so that the picture stays.

Knows nothing about light: which to split, and along which axis, is asked for.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.gaussians import Gaussians

PIECES = 5
NARROWER = 0.55
"""Width of a piece along the split axis, as a share of the whole's."""

# Five Gaussians of 0.55 sigma whose blended alpha along the axis is nearest to that of one of sigma 1, by opacity of
# the whole (least squares of alpha; largest error 0.009). In optical depth, -log(1 - alpha), pieces add up, so their
# order does not matter. Columns: opacity of the whole; of the middle, inner and outer piece; places of inner and outer.
_TABLE = (
    (0.00, 0.000, 0.000, 0.000, 0.822, 1.739),
    (0.05, 0.0357, 0.0228, 0.0051, 0.8221, 1.7390),
    (0.30, 0.2200, 0.1437, 0.0350, 0.7760, 1.6824),
    (0.50, 0.3818, 0.2503, 0.0650, 0.7366, 1.6368),
    (0.70, 0.5724, 0.3686, 0.1022, 0.6923, 1.5887),
    (0.80, 0.6883, 0.4335, 0.1244, 0.6665, 1.5625),
    (0.90, 0.8300, 0.5035, 0.1500, 0.6363, 1.5334),
    (0.95, 0.9165, 0.5406, 0.1646, 0.6186, 1.5172),
    (0.98, 0.9760, 0.5636, 0.1741, 0.6069, 1.5067),
    (0.99, 0.9974, 0.5713, 0.1774, 0.6028, 1.5031),
)


def split_along(gaussians: Gaussians, axis: Int[Tensor, "n"]) -> tuple[Gaussians, Int[Tensor, "m"]]:
    """Each Gaussian as five along its own axis `axis` (0, 1 or 2), m = 5 n, and which one each piece is of."""
    n = gaussians.count
    columns = _interpolated(gaussians.opacities.clamp_max(0.99))
    opacities = columns[:, [2, 1, 0, 1, 2]].clamp(1e-6, 0.9999)
    places = torch.stack(
        [-columns[:, 4], -columns[:, 3], torch.zeros_like(columns[:, 3]), columns[:, 3], columns[:, 4]], 1
    )
    rows = torch.arange(n)
    along = gaussians.rotations[rows, :, axis] * gaussians.scales[rows, axis][:, None]
    log_scales = gaussians.log_scales.clone()
    log_scales[rows, axis] += torch.tensor(NARROWER).log()
    origin = rows.repeat_interleave(PIECES)
    pieces = replace(
        gaussians.select(origin),
        means=(gaussians.means[:, None] + places[..., None] * along[:, None]).reshape(-1, 3),
        log_scales=log_scales[origin],
        opacity_logits=torch.logit(opacities.reshape(-1)),
    )
    return pieces, origin


def _interpolated(opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 5"]:
    table = torch.tensor(_TABLE).to(opacities)
    above = torch.searchsorted(table[:, 0].contiguous(), opacities.contiguous()).clamp(1, len(table) - 1)
    low, high = table[above - 1], table[above]
    share = ((opacities - low[:, 0]) / (high[:, 0] - low[:, 0])).clamp(0, 1)
    return (low + share[:, None] * (high - low))[:, 1:]
