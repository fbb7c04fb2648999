"""The factor on an object's linear colours that turns one place's light into another's. Knows no scene and no files."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.occlusion import LightSamples

_SPAN = 5.0  # no Gaussian changes by more than this against the object's mean change
_FLOOR = 0.08  # of the mean irradiance: interreflections that no bundle follows


def irradiance(
    beams: LightSamples, normals: Float[Tensor, "n 3"], *, arrives: Float[Tensor, "n k"]
) -> Float[Tensor, "n 3"]:
    """Linear irradiance where `arrives` is the share of every bundle that reaches each point."""
    cosine = normals @ beams.directions.T
    edge = torch.sin(beams.softness.clamp_max(math.pi / 2))
    soft = torch.where(cosine >= edge, cosine, ((cosine + edge).clamp_min(0)) ** 2 / (4 * edge))
    return (soft * arrives) @ beams.irradiance


def shade_ratio(
    target: Float[Tensor, "n 3"],
    source: Float[Tensor, "n 3"],
    normals: Normals,
    opacities: Float[Tensor, "n"],
    *,
    seen: float = 1.0,
) -> Float[Tensor, "n 3"]:
    """Irradiance at the new place over irradiance at the old one, made safe.

    Floored, clamped around the object's mean, and drawn towards that mean where the normal is unsure. The mean is drawn
    towards 1 the less of both lights was `seen`, in [0, 1], and its tint more so: both captures were exposed and white
    balanced for their own light. The powers, 1/2 and 3, are near least squares over rendered scenes with known light.
    """
    log_ratio = (_floored(target, opacities) / _floored(source, opacities)).log()
    middle = _mean(log_ratio, opacities)
    gray = middle.mean()
    return _safe(log_ratio - middle + seen**0.5 * gray + seen**3 * (middle - gray), normals, opacities)


def unknown_origin_ratio(
    target: Float[Tensor, "n 3"], normals: Normals, opacities: Float[Tensor, "n"]
) -> Float[Tensor, "n 3"]:
    """Ratio for an object whose old light nobody knows: half of the new light's variation, no change of the mean."""
    log_ratio = 0.5 * _floored(target, opacities).log()
    return _safe(log_ratio - _mean(log_ratio, opacities), normals, opacities)


def _mean(values: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> Float[Tensor, "1 3"]:
    weight = opacities / opacities.sum().clamp_min(1e-9)
    return (weight[:, None] * values).sum(0, keepdim=True)


def _floored(values: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    return (values + _FLOOR * _mean(values, opacities)).clamp_min(1e-6)


def _safe(log_ratio: Float[Tensor, "n 3"], normals: Normals, opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    middle = _mean(log_ratio, opacities)
    trust = (1.6 * normals.confidence).clamp(0, 1)[:, None]
    spread = ((log_ratio - middle) * trust).clamp(-math.log(_SPAN), math.log(_SPAN))
    return (middle + spread).exp()
