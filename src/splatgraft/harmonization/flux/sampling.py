"""Rectified-flow sampling with the noise schedule of FLUX.1-schnell."""

from collections.abc import Callable
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

Velocity = Callable[[Tensor, float], Tensor]
"""Function from noisy latents and a noise level in [0, 1] to the velocity."""


def schnell_levels(steps: int = 4, *, start: float = 1.0) -> tuple[float, ...]:
    """Compute noise levels from `start` to 0 in `steps` equal steps; from 1: FLUX.1-schnell's schedule, not shifted.

    The number of steps does not depend on `start`: the paper's updates take the same time with both its schedules
    (Table Iterative Dataset Update), though their levels differ.
    """
    if steps < 1:
        raise ValueError(f"--sampling-steps: expected at least 1, found {steps}")
    if not 0 < start <= 1:
        raise ValueError(f"strength: expected a noise level above 0 and at most 1, found {start}")
    return (*(start * (1 - i / steps) for i in range(steps)), 0.0)


def noise(size: tuple[int, int, int], seed: int) -> Float[Tensor, "c h w"]:
    """Draw standard normal latents on the CPU, so that they do not depend on device and batch size."""
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


def noisy(
    clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], level: Float[Tensor, " b"]
) -> Float[Tensor, "b c h w"]:
    """Compute noisy latents z_t = (1 - t) z_0 + t eps (paper, Sec. 5)."""
    t = level[:, None, None, None]
    return (1 - t) * clean + t * noise


@torch.no_grad()
def sample(velocity: Velocity, start: Float[Tensor, "b c h w"], levels: tuple[float, ...]) -> Float[Tensor, "b c h w"]:
    """Integrate the velocity d z / d t = eps - z_0 from `levels[0]` to `levels[-1]` by Euler steps in float32."""
    latents = start.float()
    for level, following in pairwise(levels):
        latents = latents + (following - level) * velocity(latents, level).float()
    return latents
