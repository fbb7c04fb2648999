"""Unit vectors (even sets over the sphere, spirals over a cone, perpendicular axes, light frames) and harmonic fits."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Azimuth between successive points of a Fibonacci lattice or a Vogel spiral, radians."""


def even_directions(count: int) -> Float[Tensor, "n 3"]:
    """Spread `count` unit vectors evenly over the sphere (Fibonacci lattice)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    azimuth = i * GOLDEN_ANGLE
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], -1).float()


def even_pairs(count: int) -> Float[Tensor, "n 3"]:
    """Spread `count` (even) unit vectors over the sphere; entry i + count / 2 is exactly opposite to entry i."""
    half = even_directions(count)[: count // 2]
    return torch.cat([half, -half])


def vogel_offsets(
    axis: Float[Tensor, "3"], radii: Float[Tensor, "n"], index: Float[Tensor, "n"] | Int[Tensor, "n"]
) -> Float[Tensor, "n 3"]:
    """Compute offsets perpendicular to unit `axis`, `radii` long, each turned by `index` golden angles (Vogel 1979)."""
    right, down, _ = frames_along(axis[None])[0]
    # not index * GOLDEN_ANGLE: that rounds differently in single precision
    angle = index * math.pi * (3 - math.sqrt(5))
    return (radii * angle.cos())[:, None] * right + (radii * angle.sin())[:, None] * down


def perpendicular(axis: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Compute a unit vector perpendicular to unit `axis`, from the world axis least aligned with it."""
    world_axis = torch.eye(3, dtype=axis.dtype, device=axis.device)[int(axis.abs().argmin())]
    return torch.nn.functional.normalize(torch.linalg.cross(axis, world_axis), dim=0)


def tangents(normal: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Compute tangent and bitangent of unit `normal`: `perpendicular(normal)` and normal x tangent, right-handed."""
    tangent = perpendicular(normal)
    return tangent, torch.linalg.cross(normal, tangent)


def frames_along(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Compute light frames, x_in_light = R @ x_in_world, of unit `directions`; rows right, down, away from the light.

    The depth axis is -direction, so that depth grows away from the light. The frame jumps where |z| passes 0.9.
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
    """Fit spherical harmonics to `values` at unit `directions`, by weighted least squares.

    A ridge that grows with l(l+1), a smoothness prior, keeps bands above 0 small where weights are 0. There the
    expansion continues its surroundings, then fades to the mean.
    """
    basis = spherical_harmonics.basis(directions, degree).double()
    band = torch.tensor([float(math.isqrt(i)) for i in range(basis.shape[1])], dtype=torch.float64)
    total = weights.sum().double().clamp_min(1e-12)
    weighted = basis * (weights.double() / total)[:, None]
    ridge = torch.diag(1e-6 + 2e-3 * band * (band + 1))
    return torch.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values.double()).float()
