"""Post-processing of the image model's result: restores the composite's detail and limits changes of material.

The model's change is a ratio of linear light. `restore_detail` smooths it by a guided filter (He et al. 2010) with the
composite as the guide and multiplies it onto the composite, which undoes the autoencoder's blur (the first limitation
that the paper names). `limit_material_change` scales down the part of the ratio inside the object that is not smooth
(the second limitation).
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, srgb_from_linear


@dataclass(frozen=True)
class DetailParameters:
    """Numbers of the filter."""

    ratio_offset: float = 4e-3
    """Linear light added to both sides of a ratio. One 8-bit sRGB level near black is 3e-4; below about ten levels a
    ratio is noise."""
    edge_variance: float = 0.02
    """Variance of the guide's luma above which a step counts as an edge: a step of 0.28 inside the window.

    With smaller values the blur itself counts as an edge: 35 dB at 0.001 against 44 dB at 0.02 for a photograph of
    128 px blurred over 5 px (the setting of tests/harmonization/test_flux_detail.py)."""
    radius: int = 8
    """Pixels: structure finer than this comes from the composite. Set by hand."""


PARAMETERS = DetailParameters()


def restore_detail(
    model: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"], *, amount: float
) -> Float[Tensor, "h w 3"]:
    """Replace the model's fine structure by the composite's own.

    Args:
        model: the image model's result, sRGB in [0, 1].
        composite: the image that the model was given, sRGB in [0, 1].
        amount: weight of the restored image, in [0, 1]; 0 returns `model` itself.

    Returns:
        sRGB in [0, 1].
    """
    if amount == 0:
        return model
    ratio = _log_ratio(model, composite)
    smooth = guided_filter(ratio, _luma(composite), PARAMETERS.radius)
    restored = _apply_log_ratio(composite, smooth)
    return torch.lerp(model, restored, amount)


def limit_material_change(
    model: Float[Tensor, "h w 3"],
    composite: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    *,
    strength: float,
) -> Float[Tensor, "h w 3"]:
    """Scale the model's change of material inside the object; its change of light stays.

    The change of light is the smooth grey part of the log ratio plus one tint for the whole object; the remainder is
    taken as a change of material.

    Args:
        model: the image model's result, sRGB in [0, 1].
        composite: the image that the model was given, sRGB in [0, 1].
        mask: coverage by the object, in [0, 1].
        strength: factor on the change of material, in [0, 1]; 1 returns `model` itself.

    Returns:
        sRGB in [0, 1].
    """
    if strength == 1:
        return model
    radius = PARAMETERS.radius
    ratio = _log_ratio(model, composite)
    weight = mask[..., None]
    smooth = _box(ratio * weight, radius) / _box(weight, radius).clamp_min(1e-4)
    tint = ((smooth - smooth.mean(-1, keepdim=True)) * weight).sum((0, 1)) / weight.sum().clamp_min(1e-4)
    light = smooth.mean(-1, keepdim=True) + tint
    limited = _apply_log_ratio(composite, light + strength * (ratio - light))
    return torch.lerp(model, limited, weight)


def guided_filter(
    signal: Float[Tensor, "h w c"],
    guide: Float[Tensor, "h w"],
    radius: int,
    edge_variance: float = PARAMETERS.edge_variance,
) -> Float[Tensor, "h w c"]:
    """Smooth `signal` over (2 radius + 1)^2 pixels, preserving the edges of `guide` (He et al. 2010)."""
    g = guide[..., None]
    mean_g, mean_s = _box(g, radius), _box(signal, radius)
    variance = (_box(g * g, radius) - mean_g**2).clamp_min(0)
    slope = (_box(g * signal, radius) - mean_g * mean_s) / (variance + edge_variance)
    offset = mean_s - slope * mean_g
    return _box(slope, radius) * g + _box(offset, radius)


def _box(image: Float[Tensor, "h w c"], radius: int) -> Float[Tensor, "h w c"]:
    """Mean over the part of the window that lies in the image."""
    planes, kernel = image.permute(2, 0, 1)[:, None], 2 * radius + 1
    for size in ((kernel, 1), (1, kernel)):
        padding = (size[0] // 2, size[1] // 2)
        planes = F.avg_pool2d(planes, size, stride=1, padding=padding, count_include_pad=False)
    return planes[:, 0].permute(1, 2, 0)


def _log_ratio(model: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    offset = PARAMETERS.ratio_offset
    return ((linear_from_srgb(model) + offset) / (linear_from_srgb(composite) + offset)).log()


def _apply_log_ratio(composite: Float[Tensor, "h w 3"], log_ratio: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    offset = PARAMETERS.ratio_offset
    return srgb_from_linear((linear_from_srgb(composite) + offset) * log_ratio.exp() - offset).clamp(0, 1)


def _luma(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    return image @ image.new_tensor([0.299, 0.587, 0.114])
