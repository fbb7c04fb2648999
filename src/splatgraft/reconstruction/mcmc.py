"""Density control of 3DGS-MCMC (Kheradmand et al. 2024): relocation, growth by copies, and noise on the centres.

A fit is seen as sampling: transparent Gaussians move to opaque ones, copies keep what is drawn (Eq. 9), and noise moves
faint ones about. With the penalties on opacity and scale (`McmcOptions`) it is the published method.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.fitting import FitState, Step


@dataclass(frozen=True)
class McmcOptions:
    """The published settings (the paper's Sec. 4 and its code)."""

    dead_opacity: float = 0.005
    """Opacity up to which a Gaussian is moved to another one."""
    growth: float = 0.05
    """Share of the Gaussians that is added each time, until the budget is reached."""
    noise: float = 5e5
    """Factor on the learning rate of the centres, the size of the noise."""
    noise_opacity: float = 0.005
    """Opacity at which half of the noise is left."""
    noise_slope: float = 100.0
    """Of the logistic function of one minus opacity that fades the noise."""
    most_copies: int = 51
    """Gaussians at most that share one's place after a relocation."""
    opacity_penalty: float = 0.01
    """Weight of the mean opacity in the loss."""
    scale_penalty: float = 0.01
    """Weight of the mean scale in the loss, per world unit."""
    start_opacity: float = 0.5
    """Of all Gaussians at the start."""
    start_scale: float = 0.1
    """Factor on the scale at the start, the mean distance to the three nearest neighbours."""
    opacity_rate: float = 0.05
    """Learning rate of opacities in a run of the published length."""


@dataclass(frozen=True)
class McmcControl:
    """Schedule of relocation and growth, as a `Control` of the fit; noise is added after every step."""

    budget: int
    """Never exceeded."""
    start: int
    """Step after which Gaussians are relocated and added."""
    stop: int
    """Step from which they are not."""
    every: int
    """Steps between two relocations."""
    seed: int = 0
    """Of everything that is drawn by chance."""
    options: McmcOptions = McmcOptions()

    def update(self, state: FitState, step: Step) -> FitState:
        """Relocate transparent Gaussians and add copies where due; add noise to the centres."""
        generator = torch.Generator(state.gaussians.device)
        generator.manual_seed((self.seed * 1_000_003 + state.iteration) % 2**62 + 2)
        if self.start < state.iteration < self.stop and state.iteration % self.every == 0:
            state = self._added(self._relocated(state, generator), generator)
        return _with_noise(state, step.rate_of_means, generator, self.options)

    def _relocated(self, state: FitState, generator: torch.Generator) -> FitState:
        """Transparent Gaussians become copies of others, which are drawn by opacity and share theirs with them."""
        opacities = state.gaussians.opacities
        dead = torch.nonzero(opacities <= self.options.dead_opacity).flatten()
        weights = torch.where(opacities > self.options.dead_opacity, opacities, 0.0)
        if not len(dead) or not bool((weights > 0).any()):
            return state
        drawn = torch.multinomial(weights, len(dead), replacement=True, generator=generator)
        gaussians = _shared(state.gaussians, drawn, self.options)
        index = torch.arange(gaussians.count, device=dead.device)
        index[dead] = drawn
        return replace(state, gaussians=gaussians.select(index), moments=state.moments.reset(torch.cat([dead, drawn])))

    def _added(self, state: FitState, generator: torch.Generator) -> FitState:
        """More copies of Gaussians that are drawn by opacity."""
        count = state.gaussians.count
        wanted = min(self.budget, int((1 + self.options.growth) * count)) - count
        opacities = state.gaussians.opacities
        if wanted <= 0 or not bool((opacities > 0).any()):
            return state
        drawn = torch.multinomial(opacities, wanted, replacement=True, generator=generator)
        shared = _shared(state.gaussians, drawn, self.options)
        everyone = torch.arange(count, device=drawn.device)
        moments = state.moments.select(torch.cat([everyone, drawn]))
        fresh = torch.arange(count, count + wanted, device=drawn.device)
        return replace(
            state, gaussians=concatenate([shared, shared.select(drawn)]), moments=moments.reset(fresh), memory={}
        )


def shared_by(
    opacities: Float[Tensor, "n"], copies: Int[Tensor, "n"], options: McmcOptions = McmcOptions()
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """What each of some Gaussians at one place gets, so that together they draw what one drew (Eq. 9).

    Args:
        opacities: Of the one, in [0, 1).
        copies: How many there are in its place, itself included; at least 1.
        options: Bounds.

    Returns:
        The opacity of each, and the factor on its scales.
    """
    most = options.most_copies
    copies = copies.clamp(1, most)
    total = opacities.double()
    each = 1 - (1 - total) ** (1 / copies.double())
    # sum over i <= copies and k < i of binomial(i - 1, k) (-1)^k each^(k + 1) / sqrt(k + 1), by powers of `each`
    binomials = torch.tensor([[math.comb(i, k) for k in range(most)] for i in range(most)], dtype=torch.float64)
    by_copies = binomials.cumsum(0).to(opacities.device)[copies - 1]
    power = torch.arange(most, device=opacities.device, dtype=torch.float64)
    terms = by_copies * (-1) ** power * each[:, None] ** (power + 1) / (power + 1).sqrt()
    factor = total / terms.sum(1)
    bounded = each.clamp(options.dead_opacity, 1 - 1e-6)
    return bounded.to(opacities), factor.to(opacities)


def _shared(gaussians: Gaussians, drawn: Int[Tensor, "d"], options: McmcOptions) -> Gaussians:
    """The same Gaussians, those drawn with the opacity and scales that each of their copies has, too."""
    which, counts = drawn.unique(return_counts=True)
    opacities, factors = shared_by(gaussians.opacities[which], counts + 1, options)
    logits, log_scales = gaussians.opacity_logits.clone(), gaussians.log_scales.clone()
    logits[which] = opacities.logit()
    log_scales[which] += factors.log()[:, None]
    return replace(gaussians, opacity_logits=logits, log_scales=log_scales)


def _with_noise(state: FitState, rate: float, generator: torch.Generator, options: McmcOptions) -> FitState:
    """Noise on the centres, in each Gaussian's own shape and fading with its opacity (Eq. 8)."""
    gaussians = state.gaussians
    means = gaussians.means
    faint = torch.sigmoid(options.noise_slope * (options.noise_opacity - gaussians.opacities))
    noise = torch.randn(means.shape, generator=generator, device=means.device) * (rate * options.noise * faint[:, None])
    moved = means + (gaussians.covariances @ noise[..., None])[..., 0]
    return replace(state, gaussians=replace(gaussians, means=moved))
