"""Splits Gaussians that are too wide to hold a shadow's edge into five along an axis, so that the picture stays.

Knows nothing about light: which to split, and along which axis, is asked for.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.gaussians import Gaussians

PIECES = 5
NARROWER = 0.55
"""Width of a piece along the split axis, as a share of the whole's."""

# Five Gaussians of 0.55 sigma along the axis whose blended alpha in the plane is nearest to that of one of sigma 1, by
# opacity of the whole (least squares of alpha; rms error up to 0.008, largest 0.05, both for the most opaque). In
# optical depth, -log(1 - alpha), pieces add up, so their order does not matter. Columns: opacity of the whole; of the
# middle, inner and outer piece; places of inner and outer; width of a piece across the axis.
_TABLE = (
    (0.00, 0.0000, 0.0000, 0.0000, 0.8230, 1.7401, 1.0000),
    (0.05, 0.0357, 0.0228, 0.0051, 0.8230, 1.7401, 0.9972),
    (0.30, 0.2222, 0.1433, 0.0335, 0.7927, 1.7043, 0.9814),
    (0.50, 0.3907, 0.2480, 0.0586, 0.7764, 1.6883, 0.9666),
    (0.70, 0.5901, 0.3611, 0.0841, 0.7669, 1.6829, 0.9496),
    (0.80, 0.7063, 0.4210, 0.0964, 0.7647, 1.6843, 0.9402),
    (0.90, 0.8370, 0.4834, 0.1081, 0.7646, 1.6888, 0.9303),
    (0.95, 0.9087, 0.5153, 0.1135, 0.7655, 1.6924, 0.9252),
    (0.98, 0.9540, 0.5348, 0.1166, 0.7663, 1.6950, 0.9221),
    (0.99, 0.9694, 0.5413, 0.1176, 0.7667, 1.6960, 0.9210),
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
    log_scales = gaussians.log_scales + columns[:, 5:].log()
    log_scales[rows, axis] = gaussians.log_scales[rows, axis] + math.log(NARROWER)
    origin = rows.repeat_interleave(PIECES)
    pieces = replace(
        gaussians.select(origin),
        means=(gaussians.means[:, None] + places[..., None] * along[:, None]).reshape(-1, 3),
        log_scales=log_scales[origin],
        opacity_logits=torch.logit(opacities.reshape(-1)),
    )
    return pieces, origin


def _interpolated(opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 6"]:
    table = torch.tensor(_TABLE).to(opacities)
    above = torch.searchsorted(table[:, 0].contiguous(), opacities.contiguous()).clamp(1, len(table) - 1)
    low, high = table[above - 1], table[above]
    share = ((opacities - low[:, 0]) / (high[:, 0] - low[:, 0])).clamp(0, 1)
    return (low + share[:, None] * (high - low))[:, 1:]
