"""Conversion between bytes and raw Gaussian fields, shared by the compressed scene formats."""

from pathlib import Path

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from splatgraft.core.gaussians import Gaussians


def logits_from_bytes(alphas: UInt8[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Opacity logits; 0 and 255 become a quarter step inside (0, 1), so that they stay finite and round back."""
    return (alphas.float().clamp(0.25, 254.75) / 255).logit()


def logits_from_unit(opacities: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Opacity logits of linear opacities; 0 and 1 become finite, by a quarter step of 16 bits."""
    step = 0.25 / 65535
    return opacities.clamp(step, 1 - step).logit()


def bytes_from_unit(values: Float[Tensor, "*n"]) -> UInt8[Tensor, "*n"]:
    """The nearest byte of values meant for [0, 1]; those outside saturate."""
    return (values * 255).round().clamp(0, 255).to(torch.uint8)


def smallest_three(quaternions: Float[Tensor, "n 4"]) -> tuple[Int64[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Index of the largest component of unit quaternions, and the other three, of the sign that makes it positive."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    largest = unit.abs().argmax(1, keepdim=True)
    unit = torch.where(unit.gather(1, largest) < 0, -unit, unit)
    axes = torch.arange(3) + (torch.arange(3) >= largest)
    return largest[:, 0], unit.gather(1, axes)


def writable(path: Path, gaussians: Gaussians, kind: str) -> Gaussians:
    """The Gaussians in float32 on the CPU, of which there is at least one, all finite.

    Args:
        path: The file that is written, for the message.
        gaussians: The scene.
        kind: What the message calls the format.

    Raises: ValueError where there are no Gaussians, or some are not finite.
    """
    if gaussians.count == 0:
        raise ValueError(f"{path}: expected at least one Gaussian for a {kind} file, found none")
    require_finite(path, gaussians)
    return gaussians.map(lambda tensor: tensor.detach().cpu().float())


def require_finite(path: Path, gaussians: Gaussians) -> None:
    """Check that all fields are finite, as quantised formats store neither nan nor infinity.

    Raises: ValueError where a field of any Gaussian is not finite.
    """
    fields = [gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh.flatten(1)]
    bad = ~torch.isfinite(torch.cat(fields, 1)).all(1) | gaussians.opacity_logits.isnan()
    if bool(bad.any()):
        raise ValueError(
            f"{path}: expected finite Gaussians in a {path.suffix} file, "
            f"found {int(bad.sum())} of {gaussians.count} that are not (only .ply keeps them)"
        )
