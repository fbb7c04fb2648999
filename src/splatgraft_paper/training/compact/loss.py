"""The compact network's loss: errors by region, squared errors, gradients, and being worse than the prior."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import srgb_from_linear
from splatgraft.harmonization.compact.features import CompactInput, CompactOutput, apply_output


@dataclass(frozen=True)
class LossSettings:
    """Weights and thresholds, set by hand."""

    ratio_offset: float = 0.01
    """Linear light added to both sides of a ratio."""
    shadow_ratio: float = 0.95
    """Truth over background below which a pixel is in shadow."""
    max_outside_coverage: float = 0.02
    """Coverage by the object below which a pixel is off the object."""
    min_area: float = 0.003
    """Share of the image added to a region's area in its mean, so that small regions count less."""
    object_and_shadow: float = 0.6
    """Weight of the absolute errors of object and shadow."""
    rest: float = 4.0
    """Weight of the absolute error elsewhere."""
    srgb: float = 2.0
    """Weight of the sRGB difference in the absolute error."""
    log: float = 0.3
    """Weight of the log difference in the absolute error."""
    squared_object: float = 4.0
    """Weight of the squared sRGB error of the object."""
    squared_shadow: float = 2.0
    """Weight of the squared error of the light ratio in the shadow."""
    gradients: float = 0.5
    """Weight of the error of gradients."""
    uncertainty: float = 0.02
    """Weight of the likelihood of the expected error."""
    max_light: float = 4.0
    """Linear light to which the image is clipped where the truth is not clipped."""
    clipped_truth: float = 0.99
    """Linear light from which the truth counts as clipped."""


SETTINGS = LossSettings()


@dataclass(frozen=True)
class Errors:
    """Mean error of each image of a batch, by region."""

    object: Float[Tensor, "b"]
    shadow: Float[Tensor, "b"]
    rest: Float[Tensor, "b"]


def regions(view: CompactInput, truth: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (b 1 h w) of the object, of its shadow and of the rest."""
    offset = SETTINGS.ratio_offset
    ratio = (truth.mean(1, keepdim=True) + offset) / (view.background.mean(1, keepdim=True) + offset)
    outside = (view.mask < SETTINGS.max_outside_coverage).to(truth)
    shadow = outside * (ratio < SETTINGS.shadow_ratio)
    return view.mask, shadow, outside - shadow


def region_errors(image: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"], view: CompactInput) -> Errors:
    """Average the sRGB and log errors of `image` over each region; images are linear light."""
    error = _absolute_error(image, truth)
    object_, shadow, rest = regions(view, truth)
    return Errors(_mean(error, object_), _mean(error, shadow), _mean(error, rest))


def compact_loss(
    view: CompactInput, output: CompactOutput, truth: Float[Tensor, "b 3 h w"]
) -> tuple[Tensor, Errors, Errors]:
    """Compute the loss.

    Args:
        view: the network's input.
        output: its prediction.
        truth: the ground truth, linear light.

    Returns:
        The loss, the errors of the harmonised view, and the errors of the prior.
    """
    image = apply_output(view, output)
    errors, prior_errors = region_errors(image, truth, view), region_errors(view.prior(), truth, view)
    loss = SETTINGS.object_and_shadow * (errors.object + errors.shadow) + SETTINGS.rest * errors.rest
    for name in ("object", "shadow", "rest"):
        loss = loss + (getattr(errors, name) - getattr(prior_errors, name)).clamp_min(0)
    loss = loss + _squared_errors(image, truth, view) + SETTINGS.gradients * _gradient_errors(image, truth, view)
    likelihood = _error_likelihood(image.detach(), truth, output)
    return loss.mean() + SETTINGS.uncertainty * likelihood, errors, prior_errors


def _absolute_error(image: Tensor, truth: Tensor) -> Float[Tensor, "b 1 h w"]:
    clipped, offset = _clipped(image, truth), SETTINGS.ratio_offset
    srgb = (srgb_from_linear(clipped) - srgb_from_linear(truth.clamp(1e-6, 1))).abs()
    log = ((clipped + offset) / (truth + offset)).log().abs()
    return (SETTINGS.srgb * srgb + SETTINGS.log * log).mean(1, keepdim=True)


def _clipped(image: Tensor, truth: Tensor) -> Tensor:
    """Clip the image to 1 where the truth is clipped; elsewhere excess light stays an error."""
    unclipped = truth < SETTINGS.clipped_truth
    return torch.where(unclipped, image.clamp_max(SETTINGS.max_light), image.clamp_max(1)).clamp_min(1e-6)


def _squared_errors(image: Tensor, truth: Tensor, view: CompactInput) -> Float[Tensor, "b"]:
    """Squared errors: of sRGB on the object, of the ratio to the background in shadows.

    Their minimum is the mean of the possible results. That of absolute errors is the median, which is no shadow where a
    shadow is less likely than not.
    """
    object_, shadow, _ = regions(view, truth)
    clipped = _clipped(image, truth)
    srgb = (srgb_from_linear(clipped) - srgb_from_linear(truth.clamp(1e-6, 1))) ** 2
    ratio = ((clipped - truth) / (view.background + 2 * SETTINGS.ratio_offset)).clamp(-2, 2) ** 2
    on_object = SETTINGS.squared_object * _mean(srgb.mean(1, keepdim=True), object_)
    return on_object + SETTINGS.squared_shadow * _mean(ratio.mean(1, keepdim=True), shadow)


def _mean(values: Tensor, weight: Tensor) -> Float[Tensor, "b"]:
    """Mean over a region of each image; small regions count less than their share."""
    area = weight.sum((1, 2, 3))
    image_area = values.shape[-1] * values.shape[-2]
    return (values * weight).sum((1, 2, 3)) / (area + SETTINGS.min_area * image_area)


def _gradient_errors(image: Tensor, truth: Tensor, view: CompactInput) -> Float[Tensor, "b"]:
    """Differences of the log ratio between neighbouring pixels, on the object and in its shadow."""
    offset = SETTINGS.ratio_offset
    ratio = ((_clipped(image, truth) + offset) / (truth + offset)).log().clamp(-2, 2)
    object_, shadow, _ = regions(view, truth)
    weight = (object_ + shadow).clamp_max(1)
    across = _mean((ratio[..., 1:] - ratio[..., :-1]).abs().mean(1, keepdim=True), weight[..., 1:])
    down = _mean((ratio[..., 1:, :] - ratio[..., :-1, :]).abs().mean(1, keepdim=True), weight[..., 1:, :])
    return across + down


def _error_likelihood(image: Tensor, truth: Tensor, output: CompactOutput) -> Tensor:
    """Negative log likelihood of the error under a Laplace distribution; trains only the expected error."""
    error = (
        (srgb_from_linear(image.clamp(1e-6, 1)) - srgb_from_linear(truth.clamp(1e-6, 1))).abs().mean(1, keepdim=True)
    )
    size = output.log_error.shape[-2:]
    error = torch.nn.functional.interpolate(error, size=size, mode="area")
    return (error * (-output.log_error).exp() + output.log_error).mean()
