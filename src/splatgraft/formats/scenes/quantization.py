"""Conversion between bytes and raw Gaussian fields, and the order of Gaussians, in compressed scene formats."""

from pathlib import Path

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians

SMALLEST_SCALE = 1e-30
"""Linear scale, world units, that replaces 0, because its logarithm is stored."""
HALF_SQRT2 = 0.5**0.5
"""Largest magnitude of a component besides the largest of a unit quaternion."""
_MORTON_BITS = 10  # per axis


def from_linear(
    positions: Float[Tensor, "n 3"],
    scales: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    rgba: UInt8[Tensor, "n 4"],
) -> Gaussians:
    """Make Gaussians of SH degree 0 from linear scales and bytes of sRGB and opacity, as in .splat and .ksplat."""
    # a .splat has no signature that tells it from other files
    if not (positions.isfinite().all() and scales.isfinite().all() and (scales >= 0).all()):
        raise ValueError("expected finite positions and scales of 0 or more, found others: is it another format?")
    return Gaussians(
        means=positions,
        log_scales=scales.clamp_min(SMALLEST_SCALE).log(),
        quaternions=quaternions,
        opacity_logits=logits_from_bytes(rgba[:, 3]),
        sh=spherical_harmonics.dc_from_rgb(rgba[:, :3].float() / 255)[:, None],
    )


def logits_from_bytes(alphas: UInt8[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Convert bytes to opacity logits; 0 and 255 move a quarter step inwards, to stay finite and round back."""
    return (alphas.float().clamp(0.25, 254.75) / 255).logit()


def bytes_from_unit(values: Float[Tensor, "*n"]) -> UInt8[Tensor, "*n"]:
    """Round values in [0, 1] to bytes; others saturate."""
    return (values * 255).round().clamp(0, 255).to(torch.uint8)


def smallest_three(quaternions: Float[Tensor, "n 4"]) -> tuple[Int64[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Split unit quaternions into the index of the largest component and the other three, with the largest positive."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    largest = unit.abs().argmax(1, keepdim=True)
    unit = torch.where(unit.gather(1, largest) < 0, -unit, unit)
    return largest[:, 0], unit.gather(1, _others(largest))


def from_smallest_three(largest: Int64[Tensor, "n"], three: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Join quaternions from the index of the largest component and the other three; inverts `smallest_three`."""
    largest = largest[:, None]
    out = torch.zeros(len(three), 4).scatter_(1, _others(largest), three)
    return out.scatter_(1, largest, (1 - three.square().sum(1, keepdim=True)).clamp_min(0).sqrt())


def _others(largest: Int64[Tensor, "n 1"]) -> Int64[Tensor, "n 3"]:
    return torch.arange(3) + (torch.arange(3) >= largest)


def writable(path: Path, gaussians: Gaussians, *, least: int = 1) -> Gaussians:
    """Check that there are `least` Gaussians, all finite, and move them to the CPU as float32; .ply needs no check."""
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
    """Sort `points` along a Morton curve, so that neighbours in a file are neighbours in space; returns indices.

    Each axis has 1024 cells, bounded by quantiles because scenes have a few points far away.
    """
    ranks = points.argsort(dim=0, stable=True).argsort(dim=0)
    cells = ranks * (1 << _MORTON_BITS) // max(1, len(points))
    code = torch.zeros(len(points), dtype=torch.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code.argsort(stable=True)
