"""The model's light on the composite's own pixels: the cure for the autoencoder's blur and for changed materials.

The model's change is taken as a ratio of linear light, smoothed along the composite's edges, and multiplied onto the
composite (the first limitation that the paper names); inside the object what of that ratio is not smooth, the
material's change, can be held back (its second). Knows nothing about models.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, srgb_from_linear

_FLOOR = 4e-3
"""Of linear light, one level of sRGB at 8 bits near black is 3e-4: below some ten levels a ratio is only noise."""
_EDGE = 0.02
"""Variance of the guide's luma above which a step counts as an edge: one of 0.28 inside the window.

Lower, and the blur that is to be cured passes as an edge: 35 dB at 0.001 against 44 at 0.02 for a photograph of 128 px
blurred over 5 (tests/harmonize/test_flux_detail.py)."""


def with_detail(
    model: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"], *, amount: float, radius: int = 8
) -> Float[Tensor, "h w 3"]:
    """The composite under the model's low-frequency light, mixed with the model's own picture by `amount` in [0, 1].

    `radius` px: what is finer than it comes from the composite.
    """
    if amount == 0:
        return model
    ratio = _log_ratio(model, composite)
    smooth = guided_filter(ratio, _luma(composite), radius)
    lit = _relit(composite, smooth)
    return torch.lerp(model, lit, amount)


def with_material_held(
    model: Float[Tensor, "h w 3"],
    composite: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    *,
    strength: float,
    radius: int = 8,
) -> Float[Tensor, "h w 3"]:
    """Inside the object, the model's change of light whole and its change of material scaled by `strength` in [0, 1].

    Light is what of the log ratio is smooth over the object and a tint common to all of it; the rest, fine and
    coloured, is what would turn metal into glass.
    """
    if strength == 1:
        return model
    ratio = _log_ratio(model, composite)
    weight = mask[..., None]
    smooth = _box(ratio * weight, radius) / _box(weight, radius).clamp_min(1e-4)
    tint = ((smooth - smooth.mean(-1, keepdim=True)) * weight).sum((0, 1)) / weight.sum().clamp_min(1e-4)
    light = smooth.mean(-1, keepdim=True) + tint
    held = _relit(composite, light + strength * (ratio - light))
    return torch.lerp(model, held, weight)


def guided_filter(
    signal: Float[Tensor, "h w c"], guide: Float[Tensor, "h w"], radius: int, edge: float = _EDGE
) -> Float[Tensor, "h w c"]:
    """The signal smoothed over (2 radius + 1)^2 px but not across the guide's edges (He et al. 2010)."""
    g = guide[..., None]
    mean_g, mean_s = _box(g, radius), _box(signal, radius)
    variance = (_box(g * g, radius) - mean_g**2).clamp_min(0)
    slope = (_box(g * signal, radius) - mean_g * mean_s) / (variance + edge)
    offset = mean_s - slope * mean_g
    return _box(slope, radius) * g + _box(offset, radius)


def _box(image: Float[Tensor, "h w c"], radius: int) -> Float[Tensor, "h w c"]:
    """Mean over the part of the window that lies in the picture."""
    planes, kernel = image.permute(2, 0, 1)[:, None], 2 * radius + 1
    for size in ((kernel, 1), (1, kernel)):
        padding = (size[0] // 2, size[1] // 2)
        planes = F.avg_pool2d(planes, size, stride=1, padding=padding, count_include_pad=False)
    return planes[:, 0].permute(1, 2, 0)


def _log_ratio(model: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    return ((linear_from_srgb(model) + _FLOOR) / (linear_from_srgb(composite) + _FLOOR)).log()


def _relit(composite: Float[Tensor, "h w 3"], log_ratio: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    return srgb_from_linear((linear_from_srgb(composite) + _FLOOR) * log_ratio.exp() - _FLOOR).clamp(0, 1)


def _luma(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    return image @ image.new_tensor([0.299, 0.587, 0.114])
