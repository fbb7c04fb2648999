"""What the compact network is asked to make small: log ratios by region, gradients, and doing worse than the prior."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import srgb_from_linear
from splatgraft.harmonization.compact.features import CompactInput, CompactOutput, apply_output

_LIFT = 0.01
_SHADOW = 0.95
"""Truth over background below which a pixel is in the shadow."""


@dataclass(frozen=True)
class Errors:
    """Mean errors of every picture of a batch (b,), per region."""

    object: Float[Tensor, "b"]
    shadow: Float[Tensor, "b"]
    rest: Float[Tensor, "b"]


def regions(view: CompactInput, truth: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (b 1 h w) of the object, of the shadow band and of the rest."""
    ratio = (truth.mean(1, keepdim=True) + _LIFT) / (view.background.mean(1, keepdim=True) + _LIFT)
    off = (view.mask < 0.02).to(truth)
    shadow = off * (ratio < _SHADOW)
    return view.mask, shadow, off - shadow


def region_errors(image: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"], view: CompactInput) -> Errors:
    """sRGB and log error of `image`, linear, averaged over each region."""
    apart = _apart(image, truth)
    object_, shadow, rest = regions(view, truth)
    return Errors(_mean(apart, object_), _mean(apart, shadow), _mean(apart, rest))


def compact_loss(
    view: CompactInput, output: CompactOutput, truth: Float[Tensor, "b 3 h w"]
) -> tuple[Tensor, Errors, Errors]:
    """The loss, the errors of the output, and those of the prior."""
    image = apply_output(view, output)
    found, before = region_errors(image, truth, view), region_errors(view.prior(), truth, view)
    loss = 0.6 * (found.object + found.shadow) + 4 * found.rest
    for name in ("object", "shadow", "rest"):
        loss = loss + (getattr(found, name) - getattr(before, name)).clamp_min(0)
    loss = loss + _squares(image, truth, view) + 0.5 * _gradients(image, truth, view)
    return loss.mean() + 0.02 * _doubt(image.detach(), truth, output), found, before


def _apart(image: Tensor, truth: Tensor) -> Float[Tensor, "b 1 h w"]:
    seen = _seen(image, truth)
    srgb = (srgb_from_linear(seen) - srgb_from_linear(truth.clamp(1e-6, 1))).abs()
    log = ((seen + _LIFT) / (truth + _LIFT)).log().abs()
    return (2 * srgb + 0.3 * log).mean(1, keepdim=True)


def _seen(image: Tensor, truth: Tensor) -> Tensor:
    """The image as a camera would see it where the truth is burnt out; elsewhere too much light stays too much."""
    return torch.where(truth < 0.99, image.clamp_max(4), image.clamp_max(1)).clamp_min(1e-6)


def _squares(image: Tensor, truth: Tensor, view: CompactInput) -> Float[Tensor, "b"]:
    """Squared errors, which ask for the mean of what may be: of sRGB on the object, of light over before in shadows.

    Absolute errors ask for the median, and the median of an unsure shadow is none at all.
    """
    object_, shadow, _ = regions(view, truth)
    seen = _seen(image, truth)
    apart = (srgb_from_linear(seen) - srgb_from_linear(truth.clamp(1e-6, 1))) ** 2
    ratio = ((seen - truth) / (view.background + 2 * _LIFT)).clamp(-2, 2) ** 2
    return 4 * _mean(apart.mean(1, keepdim=True), object_) + 2 * _mean(ratio.mean(1, keepdim=True), shadow)


def _mean(values: Tensor, weight: Tensor) -> Float[Tensor, "b"]:
    """Mean over a region of each picture; small regions count less than their share."""
    area = weight.sum((1, 2, 3))
    whole = values.shape[-1] * values.shape[-2]
    return (values * weight).sum((1, 2, 3)) / (area + 0.003 * whole)


def _gradients(image: Tensor, truth: Tensor, view: CompactInput) -> Float[Tensor, "b"]:
    """Edges of light: differences of the log ratio between neighbours, near the object."""
    ratio = ((_seen(image, truth) + _LIFT) / (truth + _LIFT)).log().clamp(-2, 2)
    object_, shadow, _ = regions(view, truth)
    weight = (object_ + shadow).clamp_max(1)
    across = _mean((ratio[..., 1:] - ratio[..., :-1]).abs().mean(1, keepdim=True), weight[..., 1:])
    down = _mean((ratio[..., 1:, :] - ratio[..., :-1, :]).abs().mean(1, keepdim=True), weight[..., 1:, :])
    return across + down


def _doubt(image: Tensor, truth: Tensor, output: CompactOutput) -> Tensor:
    """Laplace likelihood of the error; teaches only how large it is."""
    error = (
        (srgb_from_linear(image.clamp(1e-6, 1)) - srgb_from_linear(truth.clamp(1e-6, 1))).abs().mean(1, keepdim=True)
    )
    size = output.log_error.shape[-2:]
    error = torch.nn.functional.interpolate(error, size=size, mode="area")
    return (error * (-output.log_error).exp() + output.log_error).mean()
