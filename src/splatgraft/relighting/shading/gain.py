"""One gain per colour channel from the mean light around an object's old and new place; applied to Gaussians.

The simplest light transfer: exposure and white balance, no shading and no shadow.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.relighting.light.panorama import Panorama

_DARKEST = 1e-4
"""Linear light, a third of one 8-bit step; darker light counts as this."""


@dataclass(frozen=True)
class GainOptions:
    """Limits of a gain, all set by hand."""

    largest: float = 4.0
    """Most factor by which a channel is multiplied or divided."""
    largest_tint: float = 1.6
    """Most factor between a channel and the mean of the three; more is likely a coloured wall, not the light."""
    trusted_coverage: float = 0.5
    """Share of directions, in [0, 1]; where less was captured the gain is moved towards 1 in proportion."""


@dataclass(frozen=True)
class LocalGain:
    """The gain of one object, with the two lights that it is the ratio of."""

    gain: Float[Tensor, "3"]
    """Factor on linear rgb."""
    source_light: Float[Tensor, "3"]
    """Mean linear radiance on the object where it was captured."""
    target_light: Float[Tensor, "3"]
    """The same where it is placed."""
    source_coverage: float
    """Share of that light's directions that the source's capture covers, in [0, 1]."""
    target_coverage: float
    """The same in the target."""
    held_back: bool
    """Whether a limit or missing coverage made the gain smaller than measured."""

    def describe(self) -> str:
        """One line for a report."""
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
    """The mean light at an object's new place over that at its old one, per channel, in linear light, limited.

    Args:
        source: Panorama at the old place, with the object removed.
        target: Panorama at the new place. The gain is 1 where either covers nothing.
        source_up: Unit, in the source's frame.
        target_up: Unit, in the target's frame.
        options: Limits.
    """
    source_light, source_coverage = mean_light(source, source_up)
    target_light, target_coverage = mean_light(target, target_up)
    measured = (target_light.clamp_min(_DARKEST) / source_light.clamp_min(_DARKEST)).log()
    exposure = measured.mean()
    tint = math.log(options.largest_tint)
    bounded = (exposure + (measured - exposure).clamp(-tint, tint)).clamp(
        -math.log(options.largest), math.log(options.largest)
    )
    share = min(1.0, min(source_coverage, target_coverage) / options.trusted_coverage)
    gain = (bounded * share).exp()
    return LocalGain(
        gain=gain,
        source_light=source_light,
        target_light=target_light,
        source_coverage=source_coverage,
        target_coverage=target_coverage,
        held_back=bool((gain.log() - measured).abs().max() > 1e-3),
    )


def mean_light(panorama: Panorama, up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], float]:
    """Mean radiance that reaches a dome on a surface, and the coverage of the directions that light it.

    The mean over all normals of the upper hemisphere weights light from direction d by (1 + d . up) / 2, the integral
    of the clamped cosine. Directions that were not captured are assumed to be as bright as the rest.

    Args:
        panorama: At the dome's place.
        up: Unit, the axis of the dome.

    Returns:
        Linear rgb radiance, and the weighted share of directions that were captured, in [0, 1].
    """
    cosine = panorama.directions @ torch.nn.functional.normalize(up, dim=0).to(panorama.directions)
    weight = (1 + cosine) / 2 * panorama.solid_angles
    seen = weight * panorama.alpha
    light = (panorama.radiance * seen[..., None]).sum((0, 1, 2)) / seen.sum().clamp_min(1e-12)
    return light, float(seen.sum() / weight.sum())


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
