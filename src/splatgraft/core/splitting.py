"""Splitting of wide Gaussians into five narrower ones along one axis, with almost the same render.

Used for Gaussians of the target around an object (`split_wide_around`) and for those on which a shadow's edge falls.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians, concatenate

PIECES = 5
PIECE_WIDTH = 0.55
"""Width of a piece along the split axis, over the width of the whole."""

# Five Gaussians of 0.55 sigma whose blended alpha is nearest to that of the whole, by least squares; the rms error is
# up to 0.008, the largest 0.05, both for the most opaque. Their optical depths, -log(1 - alpha), add up in any order.
# Columns: opacity of the whole; of the middle, inner and outer piece; places of inner and outer piece along the axis
# and width of a piece across it, both over the whole's.
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
    """Split each Gaussian into five along its own axis 0, 1 or 2; returns m = 5 n pieces and their origins."""
    n = gaussians.count
    columns = _pieces_by_opacity(gaussians.opacities.clamp_max(0.99))
    opacities = columns[:, [2, 1, 0, 1, 2]].clamp(1e-6, 0.9999)
    places = torch.stack(
        [-columns[:, 4], -columns[:, 3], torch.zeros_like(columns[:, 3]), columns[:, 3], columns[:, 4]], 1
    )
    rows = torch.arange(n, device=gaussians.device)
    along = gaussians.rotations[rows, :, axis] * gaussians.scales[rows, axis][:, None]
    log_scales = gaussians.log_scales + columns[:, 5:].log()
    log_scales[rows, axis] = gaussians.log_scales[rows, axis] + math.log(PIECE_WIDTH)
    origin = rows.repeat_interleave(PIECES)
    pieces = replace(
        gaussians.select(origin),
        means=(gaussians.means[:, None] + places[..., None] * along[:, None]).reshape(-1, 3),
        log_scales=log_scales[origin],
        opacity_logits=torch.logit(opacities.reshape(-1)),
    )
    return pieces, origin


def _pieces_by_opacity(opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 6"]:
    """Interpolate columns 2 to 7 of the table linearly."""
    table = torch.tensor(_TABLE).to(opacities)
    above = torch.searchsorted(table[:, 0].contiguous(), opacities.contiguous()).clamp(1, len(table) - 1)
    low, high = table[above - 1], table[above]
    share = ((opacities - low[:, 0]) / (high[:, 0] - low[:, 0])).clamp(0, 1)
    return (low + share[:, None] * (high - low))[:, 1:]


# which Gaussians around an object are split; set by hand on the benchmark scenes
_MIN_WIDTH = 0.25  # minimum standard deviation along the widest axis, object radii
_REACH = 1.5  # largest distance of a centre from the object's, object radii, plus two standard deviations
_FARTHEST = 6.0  # largest distance of any centre, object radii
_MAX_PER_ROUND = 4000
"""Maximum number of Gaussians split per round and object; a scene of a million small Gaussians has none that wide."""


def split_wide_around(
    gaussians: Gaussians, is_object: Bool[Tensor, "n"], objects: Sequence[Gaussians]
) -> tuple[Gaussians, Bool[Tensor, "m"]]:
    """Split the wide Gaussians of a composite's target that lie around its placed objects.

    Renderers blend Gaussians in the order of their centres. A plain table is reconstructed with Gaussians wider than
    the objects on it. If the centre of one is nearer to the camera than the object, it covers the object's foot,
    although it lies below. All Gaussians that are not split keep every bit and their order.
    """
    for one in objects:
        if not one.count:
            continue
        middle = 0.5 * (one.means.quantile(0.01, dim=0) + one.means.quantile(0.99, dim=0))
        radius = float((one.means - middle).norm(dim=1).quantile(0.99))
        farthest = torch.tensor(_FARTHEST * radius, device=gaussians.device)
        for _ in range(6):  # pieces that are still too wide are split again
            widest, axis = gaussians.scales.max(1)
            away = (gaussians.means - middle).norm(dim=1)
            near = away < torch.minimum(_REACH * radius + 2 * widest, farthest)
            wide = (widest > _MIN_WIDTH * radius) & (gaussians.opacities > 0.02)
            score = widest * (~is_object & near & wide)
            if not bool((score > 0).any()):
                break
            chosen = score.argsort(descending=True)[: min(_MAX_PER_ROUND, int((score > 0).sum()))]
            keep = torch.ones_like(is_object)
            keep[chosen] = False
            pieces, parent = split_along(gaussians.select(chosen), axis[chosen])
            origin = torch.cat([keep.nonzero()[:, 0], chosen[parent]])
            order = origin.argsort(stable=True)
            gaussians = concatenate([gaussians.select(keep), pieces]).select(order)
            is_object = is_object[origin[order]]
    return gaussians, is_object
