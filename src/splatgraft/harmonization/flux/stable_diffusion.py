"""The noise schedule of Stable Diffusion and DDIM on it (Song et al. 2021). Knows no network and no picture."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

Prediction = Literal["noise", "velocity"]
Network = Callable[[Tensor, int], Tensor]
"""What the network predicts at noisy latents and a step from 0 to 999."""


@dataclass(frozen=True)
class NoiseSchedule:
    """How much of the picture is left at each step."""

    kept: Float[Tensor, " s"]
    """alpha-bar: the share of the picture's variance."""

    @staticmethod
    def stable_diffusion() -> "NoiseSchedule":
        """1000 steps, betas linear in their square roots from 0.00085 to 0.012."""
        betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
        return NoiseSchedule(torch.cumprod(1 - betas, 0).float())

    def parts(self, step: Int[Tensor, " b"]) -> tuple[Float[Tensor, "b 1 1 1"], Float[Tensor, "b 1 1 1"]]:
        """Factors of picture and noise at these steps."""
        kept = self.kept.to(step.device)[step][:, None, None, None]
        return kept.sqrt(), (1 - kept).sqrt()

    def noisy(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], step: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        """Latents at these steps."""
        a, s = self.parts(step)
        return a * clean + s * noise

    def velocity(
        self, clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], step: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        """v = a eps - s x (Salimans and Ho 2022)."""
        a, s = self.parts(step)
        return a * noise - s * clean


@torch.no_grad()
def ddim(
    predict: Network, start: Float[Tensor, "b c h w"], schedule: NoiseSchedule, *, steps: int, predicts: Prediction
) -> Float[Tensor, "b c h w"]:
    """Clean latents from noise, deterministic; steps lie as far from each other as can be, the last one at 999."""
    at = [round(999 * (steps - i) / steps) for i in range(steps)]
    latents = start.float()
    for step, following in pairwise([*at, -1]):
        a, s = (float(x) for x in schedule.parts(torch.tensor([step])))
        told = predict(latents, step).float()
        clean = a * latents - s * told if predicts == "velocity" else (latents - s * told) / a
        noise = s * latents + a * told if predicts == "velocity" else told
        if following < 0:
            return clean
        a, s = (float(x) for x in schedule.parts(torch.tensor([following])))
        latents = a * clean + s * noise
    return latents
