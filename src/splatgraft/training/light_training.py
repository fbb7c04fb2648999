"""Trains the correction of the light at a place: networks that each leave out a part of the scenes.

The loss is a proper scoring rule, so that a network says how uncertain it is: minus the log likelihood of the level of
the log irradiance, of its change over normals, and of its tint, each as a normal distribution. Examples are turned
about the up axis and mirrored by chance.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.relighting.light.learned.ensemble import LightEnsemble, SeenPlaces
from splatgraft.relighting.light.learned.network import (
    LightCorrection,
    LightNetwork,
    LightNetworkSize,
    corrected_radiance,
    network_inputs,
)
from splatgraft.relighting.light.place_description import COLUMNS, cell_directions, cell_solid_angles
from splatgraft.relighting.light.radiance_correction import RatioShares
from splatgraft.runtime.progress import Progress
from splatgraft.training.light_examples import LightExample

_LEAST = 1e-6
"""Irradiance."""
_FREE_NORMALS = 4.0
"""Independent numbers that the change of irradiance over normals is worth: it is smooth."""


@dataclass(frozen=True)
class LightTrainingOptions:
    """How the networks are trained."""

    steps: int = 3000
    """Of each network."""
    batch: int = 24
    """Places per step; every scene and side is drawn as often, whatever the number of its lights."""
    rate: float = 2e-3
    """Learning rate of AdamW; it rises over a hundred steps and falls along a cosine."""
    decay: float = 0.02
    """Weight decay."""
    noise: float = 0.05
    """Standard deviation of what is added to the inputs."""
    hidden: float = 0.03
    """Probability that an input map is set to zero."""
    folds: int = 3
    """Networks; each leaves out one part of the scenes."""
    seed: int = 0
    """Of initial weights, order, turns and noise."""
    size: LightNetworkSize = field(default_factory=LightNetworkSize)


@dataclass(frozen=True)
class LightData:
    """n examples as tensors; light in log2."""

    inputs: Float[Tensor, "n f 12 24"]
    radiance: Float[Tensor, "n 12 24 3"]
    """Of the estimate, linear."""
    in_cells: Float[Tensor, "n 12 24 3"]
    """Log irradiance of that radiance."""
    estimated: Float[Tensor, "n 12 24 3"]
    """Log irradiance of the estimate, from the light itself."""
    truth: Float[Tensor, "n 12 24 3"]
    """True log irradiance."""

    @staticmethod
    def of(examples: Sequence[LightExample]) -> "LightData":
        """Of examples."""
        radiance = torch.stack([one.estimated.radiance for one in examples])
        return LightData(
            torch.stack([network_inputs(one.place) for one in examples]),
            radiance,
            _irradiance(radiance).clamp_min(_LEAST).log2(),
            torch.stack([one.estimated.irradiance for one in examples]).clamp_min(_LEAST).log2(),
            torch.stack([one.truth.irradiance for one in examples]).clamp_min(_LEAST).log2(),
        )

    def select(self, which: Int[Tensor, "m"]) -> "LightData":
        """Some of the examples."""
        return LightData(*(part[which] for part in self._parts()))

    def _parts(self) -> list[Tensor]:
        return [self.inputs, self.radiance, self.in_cells, self.estimated, self.truth]

    def turned(self, columns: int, *, mirrored: bool) -> "LightData":
        """Turned about the up axis by columns of the maps, and mirrored or not."""
        across = (3, 2, 2, 2, 2)
        parts = [part.roll(columns, axis) for part, axis in zip(self._parts(), across, strict=True)]
        if mirrored:
            parts = [part.flip(axis) for part, axis in zip(parts, across, strict=True)]
        return LightData(*parts)


@dataclass(frozen=True)
class IrradianceErrors:
    """How far log2 irradiance is from the truth, of n places; stops."""

    level: Float[Tensor, "n"]
    """Mean over normals of the gray part."""
    change: Float[Tensor, "n"]
    """Mean square over normals of the rest of the gray part."""
    tint: Float[Tensor, "n 3"]
    """Mean over normals of the channels beyond the gray part."""

    @property
    def total(self) -> Float[Tensor, "n"]:
        """Root mean square over normals of the gray part: what benchmarks/fit_light.py measures."""
        return (self.level**2 + self.change).sqrt()

    @staticmethod
    def of(found: Float[Tensor, "n 12 24 3"], truth: Float[Tensor, "n 12 24 3"]) -> "IrradianceErrors":
        """Of log2 irradiance."""
        share = cell_solid_angles() / (4 * math.pi)
        gray = found.exp2().mean(-1).log2() - truth.exp2().mean(-1).log2()
        level = (gray * share).sum((1, 2))
        change = ((gray - level[:, None, None]) ** 2 * share).sum((1, 2))
        tint = ((found - truth - gray[..., None]) * share[..., None]).sum((1, 2))
        return IrradianceErrors(level, change, tint)


@dataclass(frozen=True)
class TrainedLight:
    """The networks, and what they say of the scenes that they were not trained on."""

    ensemble: LightEnsemble
    before: IrradianceErrors
    """Of the estimates, in the order of the examples."""
    after: IrradianceErrors
    """The same by the network that left the example's scene out, with the share of its correction that is applied."""
    shares_before: RatioShares
    """What ratios between the uncorrected lights of places are worth."""
    log_sd: Float[Tensor, "n 3"]
    """What that network said of its errors: log2 standard deviations, stops."""


_APPLIED = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of a correction that are tried on the scenes left out."""


def corrected_irradiance(correction: LightCorrection, data: LightData) -> Float[Tensor, "n 12 24 3"]:
    """Log2 irradiance after the correction: its change in the cells, on top of the estimate's own."""
    after = _irradiance(corrected_radiance(correction, data.radiance)).clamp_min(_LEAST).log2()
    return data.estimated + after - data.in_cells


def _irradiance(radiance: Float[Tensor, "n 12 24 3"]) -> Float[Tensor, "n 12 24 3"]:
    normals = cell_directions().reshape(-1, 3)
    transport = (normals @ normals.T).clamp_min(0) * cell_solid_angles().reshape(-1)
    return torch.einsum("mk,bkc->bmc", transport, radiance.flatten(1, 2)).reshape(radiance.shape)


def score(correction: LightCorrection, data: LightData) -> Float[Tensor, ""]:
    """Minus the log likelihood per place, up to a constant."""
    errors = IrradianceErrors.of(corrected_irradiance(correction, data), data.truth)
    level, change, tint = (correction.log_sd * math.log(2)).unbind(1)
    value = 0.5 * errors.level**2 * torch.exp(-2 * level) + level
    value = value + _FREE_NORMALS * (0.5 * errors.change * torch.exp(-2 * change) + change)
    return (value + 0.5 * (errors.tint**2).sum(1) * torch.exp(-2 * tint) + 2 * tint).mean()


def train_light(
    examples: Sequence[LightExample], options: LightTrainingOptions, *, say: Callable[[str], None], progress: Progress
) -> TrainedLight:
    """Train the networks of an ensemble, and check each on the scenes that it left out.

    Args:
        examples: Of at least as many scenes as there are folds.
        options: How.
        say: Receives a line per network, and one on the share of their corrections that is applied.
        progress: Called with steps done, steps in all and a short text.

    Raises:
        ValueError: There are fewer scenes than folds, or the loss is not finite.
    """
    scenes = sorted({one.scene for one in examples})
    if len(scenes) < max(2, options.folds):
        raise ValueError(f"examples: expected those of at least {max(2, options.folds)} scenes, found {len(scenes)}")
    data = LightData.of(examples)
    fold_of = {scene: i % options.folds for i, scene in enumerate(scenes)}
    folds = torch.tensor([fold_of[one.scene] for one in examples])
    found = data.estimated.expand(len(_APPLIED), *data.estimated.shape).clone()
    log_sd = torch.zeros(len(examples), 3)
    networks = []
    for fold in range(options.folds):
        inside, outside = (folds != fold).nonzero()[:, 0], (folds == fold).nonzero()[:, 0]
        part = [examples[i] for i in inside.tolist()]
        network = _train(part, data.select(inside), replace(options, seed=options.seed + fold), progress)
        left_out = data.select(outside)
        with torch.no_grad():
            correction = network(left_out.inputs)
        for i, applied in enumerate(_APPLIED):
            found[i, outside] = corrected_irradiance(correction.weakened(applied), left_out)
        log_sd[outside] = correction.log_sd
        both = (left_out.estimated, found[-1, outside])
        before, after = (float(IrradianceErrors.of(values, left_out.truth).total.mean()) for values in both)
        say(f"network {fold + 1}: irradiance of scenes left out off by {after:.3f} stops, {before:.3f} uncorrected")
        networks.append(network.eval().requires_grad_(False))
    weights = _side_weights(examples)
    tried = [IrradianceErrors.of(values, data.truth) for values in found]
    best = min(range(len(_APPLIED)), key=lambda i: float((tried[i].total * weights).sum()))
    say(f"{_APPLIED[best]:.0%} of a correction comes closest to the truth on scenes left out")
    ensemble = LightEnsemble(
        tuple(networks),
        SeenPlaces.of(data.inputs),
        ratio_shares(found[best], data.truth, examples),
        _APPLIED[best],
        _sd_factors(tried[best], log_sd, weights),
    )
    return TrainedLight(
        ensemble,
        before=IrradianceErrors.of(data.estimated, data.truth),
        after=tried[best],
        shares_before=ratio_shares(data.estimated, data.truth, examples),
        log_sd=log_sd,
    )


def _side_weights(examples: Sequence[LightExample]) -> Float[Tensor, "n"]:
    """Of the examples, sum 1: lights of one side of a scene count as one place."""
    sides = [one.side for one in examples]
    weights = torch.tensor([1 / sides.count(side) for side in sides])
    return weights / weights.sum()


def _sd_factors(
    errors: IrradianceErrors, log_sd: Float[Tensor, "n 3"], weights: Float[Tensor, "n"]
) -> tuple[float, float, float]:
    """Root mean square errors over the standard deviations that were claimed for them: level, change and tint."""
    squares = torch.stack([errors.level**2, errors.change, (errors.tint**2).sum(1) / 2], 1) / log_sd.exp2() ** 2
    level, change, tint = (squares * weights[:, None]).sum(0).sqrt().clamp_min(0.1).tolist()
    return level, change, tint


def ratio_shares(
    found: Float[Tensor, "n 12 24 3"], truth: Float[Tensor, "n 12 24 3"], examples: Sequence[LightExample]
) -> RatioShares:
    """The shares by which log ratios between places come closest to the true ones, in the least squares' sense.

    An object may go from any place to any other, so all pairs count alike: the slope is that of the true on the found
    values over the places. Lights of one side of a scene count as one place.

    Args:
        found: Log2 irradiance.
        truth: The same, true.
        examples: In the same order.
    """
    weights = _side_weights(examples)
    level, tint = [], []
    for values in (found, truth):
        parts = IrradianceErrors.of(values, torch.zeros_like(values))
        level.append(parts.level[:, None])
        tint.append(parts.tint)
    return RatioShares(_slope(level[0], level[1], weights), _slope(tint[0], tint[1], weights))


def _slope(found: Float[Tensor, "n c"], truth: Float[Tensor, "n c"], weights: Float[Tensor, "n"]) -> float:
    """Of a line through centred values, in [0, 1]."""
    share = weights[:, None]
    away, true_away = (values - (share * values).sum(0) for values in (found, truth))
    slope = (share * away * true_away).sum() / (share * away**2).sum().clamp_min(1e-9)
    return float(slope.clamp(0, 1))


def _train(
    examples: Sequence[LightExample], data: LightData, options: LightTrainingOptions, progress: Progress
) -> LightNetwork:
    generator = torch.Generator().manual_seed(options.seed)
    with torch.random.fork_rng():
        torch.manual_seed(options.seed)
        network = LightNetwork(options.size)
    sides: dict[str, list[int]] = {}
    for i, one in enumerate(examples):
        sides.setdefault(one.side, []).append(i)
    groups = list(sides.values())
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=options.decay)
    for step in range(options.steps):
        share = min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * step / options.steps))
        for group in optimizer.param_groups:
            group["lr"] = options.rate * share
        chosen = torch.randint(len(groups), (options.batch,), generator=generator).tolist()
        which = [groups[i][int(torch.randint(len(groups[i]), (), generator=generator))] for i in chosen]
        columns = int(torch.randint(COLUMNS, (), generator=generator))
        mirrored = bool(torch.rand((), generator=generator) < 0.5)
        batch = data.select(torch.tensor(which)).turned(columns, mirrored=mirrored)
        noisy = batch.inputs + options.noise * torch.randn(batch.inputs.shape, generator=generator)
        is_shown = torch.rand(*noisy.shape[:2], 1, 1, generator=generator) >= options.hidden
        loss = score(network(noisy * is_shown), batch)
        if not bool(loss.isfinite()):
            raise ValueError(f"training: expected a finite loss at step {step}, found {float(loss.detach())}")
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        progress(step + 1, options.steps, f"loss {float(loss.detach()):.3f}")
    return network
