"""The result of a light transfer: a composite with shading, shadow, bounce and gloss as layers to weight and bake."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import LUMINANCE, linear_from_srgb, srgb_from_linear
from splatgraft.core.splitting import split_wide_around
from splatgraft.relighting.light.confidence import light_confidence
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.prepared_object import PreparedObject
from splatgraft.relighting.shading.gain import apply_gain

_MOST_VIEW_CHANGE = 0.9
"""Most share of the light in a shadow that a view direction takes away; set by hand."""
_LEAST_SLOPE = 1e-6
"""Of a ratio over view directions; below it nothing is seen, and divisions would overflow."""


@dataclass(frozen=True)
class LayerWeights:
    """How much of each layer is baked: 0 leaves it out, 1 is physically right, more exaggerates; and an exposure."""

    shade: float = 1.0
    """The object's own light and dark sides."""
    shadow: float = 1.0
    """What the object takes from its surroundings."""
    bounce: float = 1.0
    """What the object's lit sides give to its surroundings."""
    gloss: float = 1.0
    """Reflections on the object."""
    tint: float = 1.0
    """The change of colour within the object's shade; its brightness stays."""
    exposure: float = 0.0
    """Stops by which the object is brighter than computed, its reflections excepted; 0 is physically right."""


@dataclass(frozen=True)
class Relit:
    """A composite of m Gaussians with its light transfer in layers."""

    gaussians: Gaussians
    """The plain composite: the target's Gaussians, then the objects'; large ones in a shadow are split."""
    is_object: Bool[Tensor, "m"]
    """Which Gaussians belong to an object."""
    origin: Int[Tensor, "m"]
    """Position in `Composite.merged()` of the Gaussian that each one is, or is a piece of."""
    shade: Float[Tensor, "m 3"]
    """Factor on linear rgb; 1 outside the objects."""
    shadow: Float[Tensor, "m 3"]
    """Factor on linear rgb in (0, 1]; 1 without a shadow."""
    bounce: Float[Tensor, "m 3"]
    """Added to `shadow`, at least 0: light that an object reflects, as a share of the light without it."""
    slope: Float[Tensor, "m 3"]
    """View dependence, world axes: its product with the unit vector from the camera is added to shadow and bounce."""
    gloss: Float[Tensor, "m k 3"]
    """Coefficients that are added to the harmonics after shading."""
    bands_replaced: Bool[Tensor, "m"]
    """Whose own higher bands `gloss` replaces: they show what reflected the old light."""
    objects: tuple[Gaussians, ...]
    """The placed objects, target's frame."""
    light: Light | None
    """At the objects' place; None where there was no transfer."""
    report: tuple[str, ...]
    """Sentences: the lights that were found and their uncertainty, and what was not done and why."""
    estimate: EstimatedLight | None = None
    """What `light` rests on; None where it was told or there was no transfer."""
    received: tuple[Float[Tensor, "n 3"], ...] = ()
    """Linear rgb irradiance on the Gaussians of each object at the new place."""
    prepared: tuple[PreparedObject, ...] = ()
    """Per object its normals and the light that it was captured in; empty where there was no transfer."""

    @property
    def confidence(self) -> float:
        """How reliable the light is, in [0, 1]; 0 where there was no transfer."""
        return 0.0 if self.light is None else light_confidence(self.light)

    def bake(self, weights: LayerWeights = LayerWeights()) -> tuple[Gaussians, Bool[Tensor, "b"]]:
        """The scene to write or to draw, and which of its Gaussians belong to an object.

        Wide Gaussians of the target around the objects are split, as in `Composite.bake`.

        Args:
            weights: How much of each layer is applied.
        """
        return split_wide_around(self.shaded(weights), self.is_object, self.objects)

    def shaded(self, weights: LayerWeights = LayerWeights()) -> Gaussians:
        """The m Gaussians under the layers, in the order of `gaussians`; those that no layer changes keep every bit."""
        ratio = self.ratio(weights)
        sloped = (weights.shadow * self.slope != 0).any(1).nonzero()[:, 0]
        glossy = (
            (self.gloss != 0).flatten(1).any(1).nonzero()[:, 0] if weights.gloss else torch.zeros(0, dtype=torch.int64)
        )
        degree = spherical_harmonics.degree_of(self.gloss.shape[1]) if len(glossy) else int(len(sloped) > 0)
        sh = spherical_harmonics.with_degree(self.gaussians.sh, max(self.gaussians.sh_degree, degree))
        sh = sh.clone()
        lit = (ratio != 1).any(1).nonzero()[:, 0]
        if len(lit):
            sh[lit] = apply_gain(replace(self.gaussians, sh=sh).select(lit), ratio[lit]).sh
        if len(sloped):
            color = spherical_harmonics.rgb_from_dc(self.gaussians.sh[sloped, 0])
            slope = _srgb_slope(color, ratio[sloped], weights.shadow * self.slope[sloped])
            sh[sloped, 1:4] += spherical_harmonics.band_from_slope(slope)
        sh[self.bands_replaced, 1:] *= 1 - weights.gloss
        sh[glossy, : self.gloss.shape[1]] += weights.gloss * self.gloss[glossy]
        return replace(self.gaussians, sh=sh)

    def ratio(self, weights: LayerWeights = LayerWeights()) -> Float[Tensor, "m 3"]:
        """Factor on linear rgb that shade, tint, exposure, shadow and bounce make together."""
        shade = self.shade**weights.shade
        if weights.tint != 1:
            shade = _tinted(shade, weights.tint)
        if weights.exposure:
            shade = torch.where(self.is_object[:, None], 2**weights.exposure * shade, shade)
        return shade * (self.shadow**weights.shadow + weights.bounce * self.bounce)


def _tinted(factor: Float[Tensor, "m 3"], weight: float) -> Float[Tensor, "m 3"]:
    """A factor on linear rgb with its chromaticity to the power of `weight`, of the same luminance."""
    luminance = (factor @ LUMINANCE)[:, None].clamp_min(1e-6)
    chroma = (factor / luminance).clamp_min(1e-6) ** weight
    changed = luminance * chroma / (chroma @ LUMINANCE)[:, None]
    # what is grey keeps every bit
    return torch.where((factor == factor[:, :1]).all(1, keepdim=True), factor, changed)


def _srgb_slope(
    srgb: Float[Tensor, "n 3"], ratio: Float[Tensor, "n 3"], slope: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3 3"]:
    """Slope of sRGB colours along the world's axes (second dimension) where `ratio` of linear light has `slope`.

    By the secant between both ends, limited so that neither is black nor brighter than without a shadow.
    """
    # the squares of slopes below 1e-20 are 0 in float32
    length = slope.norm(dim=1, keepdim=True).clamp_min(_LEAST_SLOPE)
    most = torch.minimum(_MOST_VIEW_CHANGE * ratio, (1 - ratio).clamp_min(0))
    change = torch.minimum(length, most).clamp_min(_LEAST_SLOPE)
    linear = linear_from_srgb(srgb.clamp(0, 1))
    high, low = (srgb_from_linear(linear * (ratio + sign * change)) for sign in (1, -1))
    return (slope / length)[:, :, None] * (0.5 * (high - low))[:, None]


def unchanged(
    gaussians: Gaussians, is_object: Bool[Tensor, "m"], *, objects: tuple[Gaussians, ...], report: tuple[str, ...]
) -> Relit:
    """The copy-paste result, with the sentences that say why."""
    ones = torch.ones(gaussians.count, 3)
    return Relit(
        gaussians=gaussians,
        is_object=is_object,
        origin=torch.arange(gaussians.count),
        shade=ones,
        shadow=ones,
        bounce=torch.zeros_like(ones),
        slope=torch.zeros_like(ones),
        gloss=torch.zeros_like(gaussians.sh),
        bands_replaced=torch.zeros(gaussians.count, dtype=torch.bool),
        objects=objects,
        light=None,
        report=report,
    )
