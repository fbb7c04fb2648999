"""DDIM sampling (Song et al. 2021) with the noise schedule of Stable Diffusion."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

Prediction = Literal["noise", "velocity"]
Network = Callable[[Tensor, int], Tensor]
"""The network's prediction at noisy latents and a time step from 0 to 999."""


@dataclass(frozen=True)
class NoiseSchedule:
    """The signal's share of the variance at each time step."""

    alpha_bar: Float[Tensor, " s"]
    """Cumulative product of 1 - beta, in (0, 1)."""

    @staticmethod
    def stable_diffusion() -> "NoiseSchedule":
        """1000 steps, betas linear in their square roots from 0.00085 to 0.012 (its scheduler_config.json)."""
        betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
        return NoiseSchedule(torch.cumprod(1 - betas, 0).float())

    def parts(self, step: Int[Tensor, " b"]) -> tuple[Float[Tensor, "b 1 1 1"], Float[Tensor, "b 1 1 1"]]:
        """Factors of signal and noise at these time steps."""
        alpha_bar = self.alpha_bar.to(step.device)[step][:, None, None, None]
        return alpha_bar.sqrt(), (1 - alpha_bar).sqrt()

    def noisy(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], step: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        """Noisy latents at these time steps."""
        a, s = self.parts(step)
        return a * clean + s * noise

    def velocity(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], step: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        """The velocity v = a eps - s x (Salimans and Ho 2022)."""
        a, s = self.parts(step)
        return a * noise - s * clean


@torch.no_grad()
def ddim(
    predict: Network, start: Float[Tensor, "b c h w"], schedule: NoiseSchedule, *, steps: int, predicts: Prediction
) -> Float[Tensor, "b c h w"]:
    """Sample clean latents from noise, deterministically.

    Args:
        predict: the network.
        start: standard normal noise.
        schedule: the noise schedule that the network was trained with.
        steps: number of network evaluations, evenly spaced, beginning at time step 999.
        predicts: what the network predicts.
    """
    time_steps = [round(999 * (steps - i) / steps) for i in range(steps)]
    latents = start.float()
    for step, following in pairwise([*time_steps, -1]):
        a, s = (float(x) for x in schedule.parts(torch.tensor([step])))
        predicted = predict(latents, step).float()
        clean = a * latents - s * predicted if predicts == "velocity" else (latents - s * predicted) / a
        noise = s * latents + a * predicted if predicts == "velocity" else predicted
        if following < 0:
            return clean
        a, s = (float(x) for x in schedule.parts(torch.tensor([following])))
        latents = a * clean + s * noise
    return latents
