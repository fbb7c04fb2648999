"""Even sets of directions, frames that look along them, and spherical-harmonic fits. Knows nothing about scenes."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics


def even_directions(count: int) -> Float[Tensor, "n 3"]:
    """`count` unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    azimuth = i * (math.pi * (3 - math.sqrt(5)))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], -1).float()


def even_pairs(count: int) -> Float[Tensor, "n 3"]:
    """`count` (even) unit vectors; entry i + count / 2 is exactly opposite to entry i, so one is the other's back."""
    half = even_directions(count)[: count // 2]
    return torch.cat([half, -half])


def frames_along(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Rotations whose rows are right, down and away from the light: x_in_light = frame @ x_in_world.

    The depth axis is -direction, so that depth grows away from the light. Continuous except at two poles.
    """
    away = -directions
    helper = torch.where(
        directions[:, 2:].abs() < 0.9, torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    ).to(directions)
    right = torch.nn.functional.normalize(torch.linalg.cross(away, helper), dim=-1)
    return torch.stack([right, torch.linalg.cross(away, right), away], 1)


def fit_sh(
    directions: Float[Tensor, "n 3"], values: Float[Tensor, "n 3"], weights: Float[Tensor, "n"], *, degree: int = 2
) -> Float[Tensor, "k 3"]:
    """Weighted least-squares expansion of `values`; bands above 0 are held small where nothing was seen.

    The ridge grows with l(l+1), a smoothness prior: an unseen part continues its surroundings, then fades to the mean.
    """
    basis = spherical_harmonics.basis(directions, degree).double()
    band = torch.tensor([float(math.isqrt(i)) for i in range(basis.shape[1])], dtype=torch.float64)
    total = weights.sum().double().clamp_min(1e-12)
    weighted = basis * (weights.double() / total)[:, None]
    ridge = torch.diag(1e-6 + 2e-3 * band * (band + 1))
    return torch.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values.double()).float()
