"""Schnell's schedule and the sampling loop of a rectified flow. Knows nothing about networks, pictures or packing."""

from collections.abc import Callable
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

Velocity = Callable[[Tensor, float], Tensor]
"""The velocity at noisy latents and a noise level in [0, 1]."""


def schnell_levels(steps: int = 4) -> tuple[float, ...]:
    """Noise levels from 1 to 0 in equal steps: FLUX.1-schnell's schedule, which is not shifted by resolution.

    Raises: ValueError where there is no step.
    """
    if steps < 1:
        raise ValueError(f"--sampling-steps: expected at least 1, found {steps}")
    return (*(1 - i / steps for i in range(steps)), 0.0)


def noise(size: tuple[int, int, int], seed: int) -> Float[Tensor, "c h w"]:
    """Standard normal latents, the same on every machine and beside every batch."""
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


def noisy(
    clean: Float[Tensor, "b c h w"], noise: Float[Tensor, "b c h w"], level: Float[Tensor, " b"]
) -> Float[Tensor, "b c h w"]:
    """z_t = (1 - t) z_0 + t eps (paper, Sec. 4)."""
    t = level[:, None, None, None]
    return (1 - t) * clean + t * noise


@torch.no_grad()
def sample(velocity: Velocity, start: Float[Tensor, "b c h w"], levels: tuple[float, ...]) -> Float[Tensor, "b c h w"]:
    """Latents at level 0: Euler steps along the velocity d z / d t = eps - z_0, summed in float32."""
    latents = start.float()
    for level, following in pairwise(levels):
        latents = latents + (following - level) * velocity(latents, level).float()
    return latents
