"""Irradiance of Gaussians under light samples, ratios of two lights' irradiance, and their application to colours.

Colours are multiplied by the ratio of new to old irradiance (differential rendering, Debevec 1998). Its variation over
the object is applied in full, but its mean only by the shares in `ShadeSettings`.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.relighting.light.samples import LightSamples


@dataclass(frozen=True)
class ShadeSettings:
    """Shares of the shading ratio's mean, and light that no sample represents."""

    floor: float = 0.08
    """Share of the mean irradiance that is added to all: interreflections that no sample represents; set by hand."""
    level_share: float = 0.4
    """Share of the mean's gray part (in logarithms) that is applied, in [0, 1].

    It is below 1 because each capture may have been exposed for its own light, and the estimated level is uncertain.
    Chosen by benchmarks/fit_shading.py on scenes that the light was not fitted to: 0.2 to 0.4 are best there. The
    light's own training scenes ask for too much."""
    tint_share: float = 0.25
    """Share of the mean's tint that is applied, in [0, 1].

    It is small because an object turns violet or blue if the old light's tint is estimated wrongly. Chosen on 19 scenes
    that the light was not fitted to: 0 and 0.25 are equally good, 1 is worse."""


KNOWN_LIGHTS = ShadeSettings(level_share=1.0, tint_share=1.0)
"""Settings for two given lights, which are certain."""
KNOWN_SURFACES = ShadeSettings(floor=0.0, level_share=1.0, tint_share=1.0)
"""Settings for surfaces of known albedo; they have no old light, whose errors the shares and the floor damp."""
LEVEL_ERROR_STOPS = 0.5
"""Standard error of an estimated level, over the 68 places of 34 scenes (benchmarks/fit_light.py)."""
SKY_LEVEL_ERROR_STOPS = 0.3
"""Standard error of a level by a clear sky; set by hand. Nine scenes of four exams have .13 (benchmarks/LOG.md)."""


def soft_cosine(cosine: Float[Tensor, "n k"], softness: Float[Tensor, "k"]) -> Float[Tensor, "n k"]:
    """Compute the mean of max(0, cos) over a cone of radius `softness`, radians, approximated by a quadratic."""
    edge = torch.sin(softness.clamp_max(math.pi / 2))
    return torch.where(cosine >= edge, cosine, ((cosine + edge).clamp_min(0)) ** 2 / (4 * edge))


def irradiance(
    samples: LightSamples, normals: Float[Tensor, "n 3"], *, sample_visibility: Float[Tensor, "n k"]
) -> Float[Tensor, "n 3"]:
    """Compute linear rgb irradiance on surfaces.

    Args:
        samples: The k samples of a light.
        normals: Unit normals of the surfaces.
        sample_visibility: Share of every sample that reaches each surface, in [0, 1].
    """
    soft = soft_cosine(normals @ samples.directions.T, samples.softness)
    return (soft * sample_visibility) @ samples.irradiance


def shade_ratio(
    target: Float[Tensor, "n 3"],
    source: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    *,
    settings: ShadeSettings = ShadeSettings(),
) -> Float[Tensor, "n 3"]:
    """Compute the factor on an object's linear colours: irradiance at the new place over irradiance at the old one.

    The settings' shares of the object's geometric mean ratio are applied.

    Args:
        target: Linear irradiance at the new place.
        source: Linear irradiance at the old place.
        opacities: Weights of the means, in [0, 1].
        settings: Limits and shares.
    """
    scaled = target * light_scale(target, source, opacities, settings=settings)
    return _floored(scaled, opacities, settings) / _floored(source, opacities, settings)


def light_scale(
    target: Float[Tensor, "n 3"],
    source: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    *,
    settings: ShadeSettings = ShadeSettings(),
) -> Float[Tensor, "3"]:
    """Compute the factor on the new light that reduces the mean ratio to the old light to the settings' shares.

    Args:
        target: Linear irradiance at the new place.
        source: Linear irradiance at the old place.
        opacities: Weights of the means, in [0, 1].
        settings: Shares of level and tint.
    """
    log_ratio = (_floored(target, opacities, settings) / _floored(source, opacities, settings)).log()
    mean = _mean(log_ratio, opacities)[0]
    level = mean.mean()
    return ((settings.level_share - 1) * level + (settings.tint_share - 1) * (mean - level)).exp()


def unknown_origin_ratio(target: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Compute the factor for an object of unknown source light: half of the new light's variation, a mean of 1.

    Args:
        target: Linear irradiance at the new place.
        opacities: Weights of the mean, in [0, 1].
    """
    settings = ShadeSettings()
    log_ratio = 0.5 * _floored(target, opacities, settings).log()  # set by hand
    return (log_ratio - _mean(log_ratio, opacities)).exp()


def _mean(values: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> Float[Tensor, "1 3"]:
    weight = opacities / opacities.sum().clamp_min(1e-9)
    return (weight[:, None] * values).sum(0, keepdim=True)


def _floored(
    values: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"], settings: ShadeSettings
) -> Float[Tensor, "n 3"]:
    return (values + settings.floor * _mean(values, opacities)).clamp_min(1e-6)


def apply_gain(gaussians: Gaussians, gain: Float[Tensor, "3"] | Float[Tensor, "n 3"]) -> Gaussians:
    """Multiply the linear colour of Gaussians by `gain`, to first order around the mean colour in bands above 0.

    DC' = sRGB(gain * linear(DC)); higher bands are multiplied by the derivative of that curve at DC. A Gaussian whose
    gain is exactly 1 keeps every bit.
    """
    color = spherical_harmonics.rgb_from_dc(gaussians.sh[:, 0])
    lit, slope = _through_linear(color, gain.to(color).expand_as(color))
    same = (gain == 1).to(color.device).expand_as(color)
    dc = torch.where(same, gaussians.sh[:, 0], spherical_harmonics.dc_from_rgb(lit))
    higher = gaussians.sh[:, 1:] * torch.where(same, torch.ones_like(slope), slope)[:, None]
    return replace(gaussians, sh=torch.cat([dc[:, None], higher], 1))


def _through_linear(
    srgb: Float[Tensor, "n 3"], gain: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Compute sRGB colours after a gain on linear light, and their derivative by the sRGB colours before."""
    # the derivative is by the colour alone, even if the caller optimises the gain
    with torch.enable_grad():
        point = srgb.detach().requires_grad_()
        lit = srgb_from_linear(linear_from_srgb(point) * gain.detach())
        (slope,) = torch.autograd.grad(lit.sum(), point)
    return srgb_from_linear(linear_from_srgb(srgb) * gain), slope
