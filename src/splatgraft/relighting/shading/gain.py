"""The first form of light transfer: one gain per colour channel, from the light around both places. Casts no shadow."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.relighting.light.panorama import Panorama


@dataclass(frozen=True)
class GainOptions:
    """How far a gain may go."""

    largest: float = 4.0
    """No channel is multiplied or divided by more."""
    largest_tint: float = 1.6
    """No channel departs from the mean of the three by more: what exceeds it is rather a coloured wall than light."""
    trusted_coverage: float = 0.5
    """Where less of the light's sphere was captured, the gain shrinks towards 1 in proportion."""


@dataclass(frozen=True)
class LocalGain:
    """The gain of one object, and what it comes from."""

    gain: Float[Tensor, "3"]
    """Multiplies linear light, r g b."""
    source_light: Float[Tensor, "3"]
    """Mean linear radiance on the object where it was captured."""
    target_light: Float[Tensor, "3"]
    """The same where it is placed."""
    source_coverage: float
    """Share of that light's directions that the source capture covers, in [0, 1]."""
    target_coverage: float
    """The same in the target."""
    held_back: bool
    """Whether a bound or missing coverage made the gain smaller than measured."""

    def describe(self) -> str:
        """One line for people."""
        r, g, b = self.gain.tolist()
        text = (
            f"Exposure and white balance: red x{r:.2f}, green x{g:.2f}, blue x{b:.2f}. "
            f"Directions of light that were never photographed: {1 - self.source_coverage:.0%} in the source, "
            f"{1 - self.target_coverage:.0%} in the target."
        )
        return text + (" The measured change was larger and was held back." if self.held_back else "")


def local_gain(
    source: Panorama,
    target: Panorama,
    *,
    source_up: Float[Tensor, "3"],
    target_up: Float[Tensor, "3"],
    options: GainOptions = GainOptions(),
) -> LocalGain:
    """The light at the object's new place over that at its old one, per channel, in linear light.

    `source` is taken with the object removed. Without a panorama of one of them (coverage 0) the gain is 1.
    """
    before, source_coverage = mean_light(source, source_up)
    after, target_coverage = mean_light(target, target_up)
    # 1e-4 in linear light is a third of one 8-bit step: darker light is not told apart
    measured = (after.clamp_min(1e-4) / before.clamp_min(1e-4)).log()
    exposure = measured.mean()
    tint = math.log(options.largest_tint)
    bounded = (exposure + (measured - exposure).clamp(-tint, tint)).clamp(
        -math.log(options.largest), math.log(options.largest)
    )
    trust = min(1.0, min(source_coverage, target_coverage) / options.trusted_coverage)
    gain = (bounded * trust).exp()
    return LocalGain(
        gain=gain,
        source_light=before,
        target_light=after,
        source_coverage=source_coverage,
        target_coverage=target_coverage,
        held_back=bool((gain.log() - measured).abs().max() > 1e-3),
    )


def mean_light(panorama: Panorama, up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], float]:
    """Mean radiance on a dome that stands on a surface, and the coverage of the directions that matter to it.

    Over all normals of the upper hemisphere, light from direction d counts by (1 + d . up) / 2: the integral of the
    cosine. Directions that were not captured are taken to be as bright as the rest.
    """
    cosine = panorama.directions @ torch.nn.functional.normalize(up, dim=0).to(panorama.directions)
    weight = (1 + cosine) / 2 * panorama.solid_angles
    seen = weight * panorama.alpha
    light = (panorama.radiance * seen[..., None]).sum((0, 1, 2)) / seen.sum().clamp_min(1e-12)
    return light, float(seen.sum() / weight.sum())


def apply_gain(gaussians: Gaussians, gain: Float[Tensor, "3"] | Float[Tensor, "n 3"]) -> Gaussians:
    """The same Gaussians under `gain` times the light, in linear light; bands above 0 to first order around the mean.

    DC' = sRGB(gain * linear(DC)); higher bands are multiplied by the slope of that curve at DC.
    """
    color = spherical_harmonics.rgb_from_dc(gaussians.sh[:, 0])
    lit, slope = _through_linear(color, gain.to(color).expand_as(color))
    # where nothing changes, not a bit does
    same = (gain == 1).to(color.device).expand_as(color)
    dc = torch.where(same, gaussians.sh[:, 0], spherical_harmonics.dc_from_rgb(lit))
    higher = gaussians.sh[:, 1:] * torch.where(same, torch.ones_like(slope), slope)[:, None]
    return replace(gaussians, sh=torch.cat([dc[:, None], higher], 1))


def _through_linear(
    srgb: Float[Tensor, "n 3"], gain: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """sRGB after its linear light is multiplied, and the derivative of that."""
    # the gain may be a leaf of someone's optimisation: only the slope is taken here
    with torch.enable_grad():
        point = srgb.detach().requires_grad_()
        lit = srgb_from_linear(linear_from_srgb(point) * gain.detach())
        (slope,) = torch.autograd.grad(lit.sum(), point)
    return srgb_from_linear(linear_from_srgb(srgb) * gain), slope
