"""Conversion between bytes and raw Gaussian fields, and the order of Gaussians, for the compressed scene formats."""

from pathlib import Path

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians

SMALLEST_SCALE = 1e-30
"""World units; replaces a linear scale of exactly 0, since its logarithm is stored."""
_MORTON_BITS = 10


def from_linear(
    path: Path,
    positions: Float[Tensor, "n 3"],
    scales: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    rgba: UInt8[Tensor, "n 4"],
) -> Gaussians:
    """Gaussians without bands of linear scales and bytes of sRGB and opacity, as .splat and .ksplat store them."""
    if not (positions.isfinite().all() and scales.isfinite().all() and (scales >= 0).all()):
        kind = path.suffix
        raise ValueError(f"{path}: expected finite positions and scales of 0 or more, found others: is this a {kind}?")
    return Gaussians(
        means=positions,
        log_scales=scales.clamp_min(SMALLEST_SCALE).log(),
        quaternions=quaternions,
        opacity_logits=logits_from_bytes(rgba[:, 3]),
        sh=spherical_harmonics.dc_from_rgb(rgba[:, :3].float() / 255)[:, None],
    )


def logits_from_bytes(alphas: UInt8[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Opacity logits; 0 and 255 become a quarter step inside (0, 1), so that they stay finite and round back."""
    return (alphas.float().clamp(0.25, 254.75) / 255).logit()


def bytes_from_unit(values: Float[Tensor, "*n"]) -> UInt8[Tensor, "*n"]:
    """The nearest byte of values meant for [0, 1]; those outside saturate."""
    return (values * 255).round().clamp(0, 255).to(torch.uint8)


def smallest_three(quaternions: Float[Tensor, "n 4"]) -> tuple[Int64[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Index of the largest component of unit quaternions, and the other three, of the sign that makes it positive."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    largest = unit.abs().argmax(1, keepdim=True)
    unit = torch.where(unit.gather(1, largest) < 0, -unit, unit)
    return largest[:, 0], unit.gather(1, _others(largest))


def from_smallest_three(largest: Int64[Tensor, "n"], three: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions from the index of their largest component and the other three; the inverse of `smallest_three`."""
    largest = largest[:, None]
    out = torch.zeros(len(three), 4).scatter_(1, _others(largest), three)
    return out.scatter_(1, largest, (1 - three.square().sum(1, keepdim=True)).clamp_min(0).sqrt())


def _others(largest: Int64[Tensor, "n 1"]) -> Int64[Tensor, "n 3"]:
    return torch.arange(3) + (torch.arange(3) >= largest)


def writable(path: Path, gaussians: Gaussians, *, least: int = 1) -> Gaussians:
    """The Gaussians in float32 on the CPU, at least so many, all finite, as formats other than .ply need them."""
    if gaussians.count < least:
        raise ValueError(f"{path}: expected at least one Gaussian for a {path.suffix} file, found none")
    fields = [gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh.flatten(1)]
    bad = ~torch.isfinite(torch.cat(fields, 1)).all(1) | gaussians.opacity_logits.isnan()
    if bool(bad.any()):
        raise ValueError(
            f"{path}: expected finite Gaussians in a {path.suffix} file, "
            f"found {int(bad.sum())} of {gaussians.count} that are not (only .ply keeps them)"
        )
    return gaussians.map(lambda tensor: tensor.detach().cpu().float())


def morton_order(points: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """Indices of `points` along a Morton curve, in which neighbours in a file are neighbours in space.

    The curve goes through 1024 cells per axis whose bounds are quantiles, as scenes have a few points far away.
    """
    ranks = points.argsort(dim=0, stable=True).argsort(dim=0)
    cells = ranks * (1 << _MORTON_BITS) // max(1, len(points))
    code = torch.zeros(len(points), dtype=torch.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code.argsort(stable=True)
