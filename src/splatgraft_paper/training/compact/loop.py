"""Training of the compact harmoniser: its task for the training loop, and its loss.

The loss sums errors by region, squared errors, errors of gradients, and the excess of errors over the prior's. Seed
and step determine the pairs of a step and their augmentation.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.core.images import srgb_from_linear
from splatgraft.harmonization.compact.features import CompactInput, CompactOutput, apply_output
from splatgraft.harmonization.compact.network import CompactNetwork, CompactSize
from splatgraft_paper.training.compact.pairs import CompactPairs, augment, batch_inputs
from splatgraft_paper.training.loop import LoopOptions, Validation

_FINAL_RATE = 0.02  # learning rate at the last step over the maximum


@dataclass(frozen=True)
class CompactOptions:
    """Options of the training of the compact harmoniser."""

    steps: int = 2000
    batch: int = 8
    rate: float = 1e-3
    """Learning rate of AdamW; it rises over the first hundredth of the steps, then falls as a cosine."""
    decay: float = 0.05
    """Weight decay."""
    ema: float = 0.998
    """Decay of the moving average of the weights, which is the result."""
    size: tuple[int, int] = (128, 192)
    """Height and width of a training view, multiples of 16."""
    seed: int = 0
    save_every: int = 200
    validate_every: int = 500
    validation_pairs: int = 96
    bf16: bool = False
    """Compute the network in bfloat16, which halves the time on processors that support it."""
    network: CompactSize = field(default_factory=CompactSize)

    def loop(self, *, cpu: bool) -> LoopOptions:
        """Convert to the options of the training loop."""
        names = ("steps", "batch", "rate", "ema", "seed", "save_every", "validate_every", "validation_pairs")
        same = {name: getattr(self, name) for name in names}
        return LoopOptions(**same, precision="bf16" if self.bf16 else "no", readers=1, cpu=cpu)


class CompactTask:
    """The compact network on rendered pairs, as a task of the training loop."""

    def __init__(self, pairs: CompactPairs, options: CompactOptions, device: torch.device) -> None:
        """Make the network with random weights."""
        torch.manual_seed(options.seed)
        self._pairs, self._options, self._device = pairs, options, device
        self.network: nn.Module = CompactNetwork(options.network)
        settings: dict[str, Any] = {name: asdict(options)[name] for name in ("steps", "decay", "size", "network")}
        self.fingerprint: Mapping[str, Any] = {**settings, "pairs": pairs.fingerprint()}

    def optimizer(self) -> torch.optim.Optimizer:
        """Make AdamW; biases and scales do not decay."""
        groups = [
            {"params": [p for p in self.network.parameters() if p.ndim > 1], "weight_decay": self._options.decay},
            {"params": [p for p in self.network.parameters() if p.ndim <= 1], "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, lr=self._options.rate, betas=(0.9, 0.99))

    def rate_at(self, step: int) -> float:
        """Return the learning rate at a step, counted from 0."""
        steps = self._options.steps
        rise = min(1.0, (step + 1) / max(1, steps // 100))
        fall = _FINAL_RATE + (1 - _FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * step / steps))
        return self._options.rate * (rise * fall)

    def read(self, position: int) -> tuple[CompactInput, Tensor]:
        """Read and augment the view at a position; each epoch has its own order."""
        pairs, seed = self._pairs, self._options.seed
        epoch, place = divmod(position, len(pairs.training))
        order = torch.randperm(len(pairs.training), generator=torch.Generator().manual_seed(seed * 7919 + epoch))
        whole = pairs.read(pairs.training[int(order[place])])
        return augment(*whole, self._options.size, f"compact-{seed}-{position}")

    def loss(self, network: Callable[..., Any], items: Sequence[tuple[CompactInput, Tensor]]) -> Float[Tensor, ""]:
        """Compute the loss of a batch of views."""
        view = batch_inputs([view for view, _ in items]).to(self._device)
        truth = torch.cat([truth for _, truth in items]).to(self._device)
        return compact_loss(view, network(view.channels()).float(), truth)[0]

    def name(self, position: int) -> str:
        """Return the position, because pairs are in memory."""
        return f"pair {position}"

    @torch.no_grad()
    def validate(self, network: Callable[..., Any]) -> Validation:
        """Measure errors by region on the held-out pairs, of the network and of the prior.

        A row of the sheet has the composite, the prior, the network's result and the truth.
        """
        pairs, count = self._pairs, self._options.validation_pairs
        chosen = pairs.validation or pairs.training
        chosen = chosen[:: max(1, len(chosen) // count)][:count]
        totals: dict[str, float] = {}
        rows = []
        for number, index in enumerate(chosen):
            view, truth = augment(*pairs.read(index), self._options.size, f"validation-{number}")
            view, truth = view.to(self._device), truth.to(self._device)
            output = network(view.channels()).float()
            _, errors, prior_errors = compact_loss(view, output, truth)
            for region, error in errors.items():
                for key, value in ((region, error), (f"{region}_prior", prior_errors[region])):
                    totals[key] = totals.get(key, 0.0) + float(value.mean()) / len(chosen)
            if number < 12:
                pictures = (view.composite, view.prior(), apply_output(view, output), truth)
                images = [srgb_from_linear(p[0].clamp(0, 1)).permute(1, 2, 0).cpu() for p in pictures]
                rows.append(torch.cat(images, 1))
        words = ", ".join(f"{name} {value:.4f}" for name, value in totals.items())
        return Validation(totals, f"held out: {words}", torch.cat(rows))


@dataclass(frozen=True)
class LossWeights:
    """Weights and thresholds of the loss, set by hand."""

    ratio_offset: float = 0.01
    """Offset on both sides of a ratio, linear light."""
    shadow_ratio: float = 0.95
    """Ratio of truth to background below which a pixel is in shadow."""
    max_outside_coverage: float = 0.02
    """Coverage by the object below which a pixel is outside the object."""
    min_area: float = 0.003
    """Share of the image that is added to a region's area in its mean, so that small regions count less."""
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
    """Maximum of the image, linear light, at pixels whose truth is not clipped."""
    clipped_truth: float = 0.99
    """Minimum of a clipped truth, linear light."""


WEIGHTS = LossWeights()


Errors = dict[str, Float[Tensor, "b"]]
"""Mean errors of the images of a batch, by region: object, shadow and rest."""


def regions(view: CompactInput, truth: Float[Tensor, "b 3 h w"]) -> dict[str, Float[Tensor, "b 1 h w"]]:
    """Compute weights of pixels by region: object, its shadow, rest."""
    offset = WEIGHTS.ratio_offset
    ratio = (truth.mean(1, keepdim=True) + offset) / (view.background.mean(1, keepdim=True) + offset)
    outside = (view.mask < WEIGHTS.max_outside_coverage).to(truth)
    shadow = outside * (ratio < WEIGHTS.shadow_ratio)
    return {"object": view.mask, "shadow": shadow, "rest": outside - shadow}


def region_errors(image: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"], view: CompactInput) -> Errors:
    """Average the sRGB and log errors of `image` over each region; images are linear light."""
    error = _absolute_error(image, truth)
    return {name: _mean(error, weight) for name, weight in regions(view, truth).items()}


def compact_loss(
    view: CompactInput, output: CompactOutput, truth: Float[Tensor, "b 3 h w"]
) -> tuple[Tensor, Errors, Errors]:
    """Compute the loss against the truth in linear light, the harmonised view's errors, and the prior's."""
    image = apply_output(view, output)
    errors, prior_errors = region_errors(image, truth, view), region_errors(view.prior(), truth, view)
    loss = WEIGHTS.object_and_shadow * (errors["object"] + errors["shadow"]) + WEIGHTS.rest * errors["rest"]
    for name, error in errors.items():
        loss = loss + (error - prior_errors[name]).clamp_min(0)
    loss = loss + _squared_errors(image, truth, view) + WEIGHTS.gradients * _gradient_errors(image, truth, view)
    likelihood = _error_likelihood(image.detach(), truth, output)
    return loss.mean() + WEIGHTS.uncertainty * likelihood, errors, prior_errors


def _absolute_error(image: Tensor, truth: Tensor) -> Float[Tensor, "b 1 h w"]:
    clipped, offset = _clipped(image, truth), WEIGHTS.ratio_offset
    srgb = (srgb_from_linear(clipped) - srgb_from_linear(truth.clamp(1e-6, 1))).abs()
    log = ((clipped + offset) / (truth + offset)).log().abs()
    return (WEIGHTS.srgb * srgb + WEIGHTS.log * log).mean(1, keepdim=True)


def _clipped(image: Tensor, truth: Tensor) -> Tensor:
    """Clip the image to 1 where the truth is clipped, so that more light is no error there."""
    unclipped = truth < WEIGHTS.clipped_truth
    return torch.where(unclipped, image.clamp_max(WEIGHTS.max_light), image.clamp_max(1)).clamp_min(1e-6)


def _squared_errors(image: Tensor, truth: Tensor, view: CompactInput) -> Float[Tensor, "b"]:
    """Compute squared errors: of sRGB on the object, of the ratio to the background in shadows.

    Squared errors are minimal at the mean of the possible results, absolute errors at the median. The median has no
    shadow at pixels whose probability of shadow is below one half.
    """
    parts, clipped = regions(view, truth), _clipped(image, truth)
    srgb = (srgb_from_linear(clipped) - srgb_from_linear(truth.clamp(1e-6, 1))) ** 2
    ratio = ((clipped - truth) / (view.background + 2 * WEIGHTS.ratio_offset)).clamp(-2, 2) ** 2
    on_object = WEIGHTS.squared_object * _mean(srgb.mean(1, keepdim=True), parts["object"])
    return on_object + WEIGHTS.squared_shadow * _mean(ratio.mean(1, keepdim=True), parts["shadow"])


def _mean(values: Tensor, weight: Tensor) -> Float[Tensor, "b"]:
    """Average over a region of each image; small regions count less than their share."""
    area = weight.sum((1, 2, 3))
    image_area = values.shape[-1] * values.shape[-2]
    return (values * weight).sum((1, 2, 3)) / (area + WEIGHTS.min_area * image_area)


def _gradient_errors(image: Tensor, truth: Tensor, view: CompactInput) -> Float[Tensor, "b"]:
    """Average the differences of the log ratio between neighbouring pixels, on the object and in its shadow."""
    offset = WEIGHTS.ratio_offset
    ratio = ((_clipped(image, truth) + offset) / (truth + offset)).log().clamp(-2, 2)
    parts = regions(view, truth)
    weight = (parts["object"] + parts["shadow"]).clamp_max(1)
    across = _mean((ratio[..., 1:] - ratio[..., :-1]).abs().mean(1, keepdim=True), weight[..., 1:])
    down = _mean((ratio[..., 1:, :] - ratio[..., :-1, :]).abs().mean(1, keepdim=True), weight[..., 1:, :])
    return across + down


def _error_likelihood(image: Tensor, truth: Tensor, output: CompactOutput) -> Tensor:
    """Compute the negative log likelihood of the error under a Laplace distribution; it trains the expected error."""
    image, truth = (srgb_from_linear(x.clamp(1e-6, 1)) for x in (image, truth))
    error = (image - truth).abs().mean(1, keepdim=True)
    error = torch.nn.functional.interpolate(error, size=output.log_error.shape[-2:], mode="area")
    return (error * (-output.log_error).exp() + output.log_error).mean()
