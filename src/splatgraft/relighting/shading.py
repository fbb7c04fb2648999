"""Irradiance of Gaussians under light samples, ratios of two lights' irradiance, and their application to colours.

The ratio's variation over the object is applied in full; of its mean only a stated share is (ratio images, Debevec
1998).
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
    """Limits of the shading ratio."""

    span: float = 5.0
    """Most factor by which a Gaussian's ratio may differ from the object's mean ratio; set by hand."""
    floor: float = 0.08
    """Share of the mean irradiance that is added to all: interreflections that no sample follows; set by hand."""
    level_share: float = 0.4
    """Share, in [0, 1], of the mean's gray part (in logarithms) that is applied, as each capture may have been exposed
    for its own light and the estimated level is uncertain. Chosen by benchmarks/fit_shading.py on scenes that the
    light's numbers were not fitted to: there 0.2 to 0.4 are best, and what the light's own training scenes say is too
    much."""
    tint_share: float = 0.25
    """Share, in [0, 1], of the mean's tint that is applied: where the old light's tint is found wrong, an object turns
    violet or blue. Chosen on 19 scenes that the light's numbers were not fitted to: 0 and 0.25 are alike, 1 worse."""


_UNKNOWN_SHARE = 0.5  # share of the new light's variation that an object of unknown source light takes on; set by hand
KNOWN_LIGHTS = ShadeSettings(level_share=1.0, tint_share=1.0)
"""Where both lights were given: nothing is uncertain."""


def soft_cosine(cosine: Float[Tensor, "n k"], softness: Float[Tensor, "k"]) -> Float[Tensor, "n k"]:
    """Mean of max(0, cos) over a cone of radius `softness`, radians, approximated by a quadratic."""
    edge = torch.sin(softness.clamp_max(math.pi / 2))
    return torch.where(cosine >= edge, cosine, ((cosine + edge).clamp_min(0)) ** 2 / (4 * edge))


def irradiance(
    samples: LightSamples, normals: Float[Tensor, "n 3"], *, sample_visibility: Float[Tensor, "n k"]
) -> Float[Tensor, "n 3"]:
    """Linear rgb irradiance on surfaces with unit `normals`.

    Args:
        samples: The k samples of a light.
        normals: Unit.
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
    """Factor on an object's linear colours: irradiance at the new place over irradiance at the old one.

    Floored, and limited around the object's mean. Of the mean itself, a geometric one, the settings' shares are
    applied.

    Args:
        target: Linear irradiance at the new place.
        source: Linear irradiance at the old place.
        opacities: Weights of the means, in [0, 1].
        settings: Limits and shares.
    """
    scaled = target * light_scale(target, source, opacities, settings=settings)
    log_ratio = (_floored(scaled, opacities, settings) / _floored(source, opacities, settings)).log()
    return _limited(log_ratio, opacities, settings)


def light_scale(
    target: Float[Tensor, "n 3"],
    source: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    *,
    settings: ShadeSettings = ShadeSettings(),
) -> Float[Tensor, "3"]:
    """Factor on the new light after which the mean ratio to the old light has changed by the settings' shares alone.

    Args:
        target: Linear irradiance at the new place.
        source: Linear irradiance at the old place.
        opacities: Weights of the means, in [0, 1].
        settings: Shares.
    """
    log_ratio = (_floored(target, opacities, settings) / _floored(source, opacities, settings)).log()
    mean = _mean(log_ratio, opacities)[0]
    gray = mean.mean()
    return ((settings.level_share - 1) * gray + (settings.tint_share - 1) * (mean - gray)).exp()


def unknown_origin_ratio(target: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """The factor for an object of unknown source light: half of the new light's variation, a mean of 1.

    Args:
        target: Linear irradiance at the new place.
        opacities: Weights of the mean, in [0, 1].
    """
    settings = ShadeSettings()
    log_ratio = _UNKNOWN_SHARE * _floored(target, opacities, settings).log()
    return _limited(log_ratio - _mean(log_ratio, opacities), opacities, settings)


def _mean(values: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> Float[Tensor, "1 3"]:
    weight = opacities / opacities.sum().clamp_min(1e-9)
    return (weight[:, None] * values).sum(0, keepdim=True)


def _floored(
    values: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"], settings: ShadeSettings
) -> Float[Tensor, "n 3"]:
    return (values + settings.floor * _mean(values, opacities)).clamp_min(1e-6)


def _limited(
    log_ratio: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"], settings: ShadeSettings
) -> Float[Tensor, "n 3"]:
    """The ratio with its variation around the mean limited."""
    mean, span = _mean(log_ratio, opacities), math.log(settings.span)
    return (mean + (log_ratio - mean).clamp(-span, span)).exp()


def apply_gain(gaussians: Gaussians, gain: Float[Tensor, "3"] | Float[Tensor, "n 3"]) -> Gaussians:
    """Gaussians whose linear colour is multiplied by `gain`; bands above 0 to first order around the mean colour.

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
    """sRGB colours after a gain on linear light, and the derivative by the sRGB colour before."""
    # the caller may be optimising the gain: this derivative is by the colour alone
    with torch.enable_grad():
        point = srgb.detach().requires_grad_()
        lit = srgb_from_linear(linear_from_srgb(point) * gain.detach())
        (slope,) = torch.autograd.grad(lit.sum(), point)
    return srgb_from_linear(linear_from_srgb(srgb) * gain), slope
