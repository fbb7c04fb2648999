"""The result of a light transfer: a composite with shading, shadow, bounce and gloss as layers to weight and bake."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import LUMINANCE, linear_from_srgb, srgb_from_linear
from splatgraft.core.splitting import split_wide_around
from splatgraft.relighting.cast_shadows import Shadows
from splatgraft.relighting.light.description import describe_light
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.light import Light, light_confidence
from splatgraft.relighting.materials import gloss_bands, reflected_light
from splatgraft.relighting.prepared_object import PreparedObject
from splatgraft.relighting.scene_light import SceneLight
from splatgraft.relighting.shading import (
    KNOWN_LIGHTS,
    ShadeSettings,
    apply_gain,
    irradiance,
    light_scale,
    shade_ratio,
    unknown_origin_ratio,
)
from splatgraft.relighting.shadows.catchers import with_depth
from splatgraft.runtime.note import Note

_MAX_VIEW_CHANGE = 0.9  # share of the light in a shadow that a view direction takes away; set by hand
_MIN_SLOPE = 1e-6
"""Smallest slope of a ratio over view directions; below it nothing is seen, and divisions would overflow."""
_MIN_CERTAIN = 0.5
"""Share of the light that was captured and whose direction is certain, below which most of it is a guess."""
_DARKEST, _HARDLY_DARKER = 20, 0.85
"""Surroundings that are asked for a shadow, the darkest, and the factor on their light above which none is seen."""


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
    warmth: float = 0.0
    """Stops by which red gains on blue on the object, at the same brightness; 0 is physically right."""


@dataclass(frozen=True)
class Relit:
    """A composite of m Gaussians with its light transfer in layers."""

    gaussians: Gaussians
    """The plain composite: the target's Gaussians, then the objects'; large ones in a shadow are split, and invisible
    shadow catchers added."""
    is_object: Bool[Tensor, "m"]
    """Which Gaussians belong to an object."""
    origin: Int[Tensor, "m"]
    """Position in `Composite.merged()` of the Gaussian that each one is, is a piece of, or catches the shadow at."""
    shade: Float[Tensor, "m 3"]
    """Factor on linear rgb; 1 outside the objects."""
    shadow: Float[Tensor, "m 3"]
    """Factor on linear rgb in (0, 1]; 1 without a shadow."""
    bounce: Float[Tensor, "m 3"]
    """Added to `shadow`, at least 0: light that an object reflects, as a share of the light without it."""
    slope: Float[Tensor, "m 3"]
    """View dependence, world axes: its product with the unit vector from the camera is added to shadow and bounce."""
    catcher_depth: Float[Tensor, "m"]
    """Optical depth of the shadow catchers, which are invisible without it; 0 for all other Gaussians."""
    gloss: Float[Tensor, "m k 3"]
    """Coefficients that are added to the harmonics after shading."""
    bands_replaced: Bool[Tensor, "m"]
    """Whose own higher bands `gloss` replaces: they show what reflected the old light."""
    objects: tuple[Gaussians, ...]
    """The placed objects, target's frame."""
    light: Light | None
    """At the objects' place; None where there was no transfer."""
    report: tuple[Note, ...]
    """The lights that were found and their uncertainty, and what was not done and why."""
    estimate: EstimatedLight | None = None
    """What `light` rests on; None where it was given or there was no transfer."""
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
        sh[self.bands_replaced, 1:] *= max(1 - weights.gloss, 0.0)  # more gloss than 1 exaggerates the new one alone
        sh[glossy, : self.gloss.shape[1]] += weights.gloss * self.gloss[glossy]
        changed = replace(self.gaussians, sh=sh)
        catchers = (self.catcher_depth > 0).nonzero()[:, 0]
        if not len(catchers):
            return changed
        logits = changed.opacity_logits.clone()
        visible = with_depth(changed.select(catchers), weights.shadow * self.catcher_depth[catchers])
        logits[catchers] = visible.opacity_logits
        return replace(changed, opacity_logits=logits)

    def ratio(self, weights: LayerWeights = LayerWeights()) -> Float[Tensor, "m 3"]:
        """Factor on linear rgb that shade, tint, exposure, warmth, shadow and bounce make together."""
        shade = self.shade**weights.shade
        if weights.tint != 1:
            shade = _tinted(shade, weights.tint)
        if weights.exposure:
            shade = torch.where(self.is_object[:, None], 2**weights.exposure * shade, shade)
        if weights.warmth:
            warm = 2 ** (weights.warmth * shade.new_tensor([0.5, 0.0, -0.5]))
            shade = torch.where(self.is_object[:, None], warm / (warm @ LUMINANCE.to(warm)) * shade, shade)
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
    length = slope.norm(dim=1, keepdim=True).clamp_min(_MIN_SLOPE)
    most = torch.minimum(_MAX_VIEW_CHANGE * ratio, (1 - ratio).clamp_min(0))
    change = torch.minimum(length, most).clamp_min(_MIN_SLOPE)
    linear = linear_from_srgb(srgb.clamp(0, 1))
    high, low = (srgb_from_linear(linear * (ratio + sign * change)) for sign in (1, -1))
    return (slope / length)[:, :, None] * (0.5 * (high - low))[:, None]


@dataclass(frozen=True)
class _Shading:
    """How an object of n Gaussians is lit."""

    received: Float[Tensor, "n 3"]
    """Linear rgb irradiance at the new place."""
    shade: Float[Tensor, "n 3"]
    """Factor on linear rgb by its own shading."""
    gloss: Float[Tensor, "n 16 3"] | None
    """Coefficients of what it reflects at its new place; None where it is matt."""


def assemble_layers(merged: Gaussians, scene: SceneLight, objects: Sequence[PreparedObject], shadows: Shadows) -> Relit:
    """Shade the objects, and put all layers in the order of the merged composite; pieces where their whole was.

    Args:
        merged: The composite, as `Composite.merged` gives it.
        scene: The light at the objects' place.
        objects: All that have Gaussians.
        shadows: Of that light.
    """
    shadings = [_shading(one, scene, shares) for one, shares in zip(objects, shadows.scene_visibility, strict=True)]
    receivers, on_scene, catchers = shadows.receivers, shadows.on_scene, shadows.catchers
    rest = torch.ones(scene.captured.gaussians.count, dtype=torch.bool)
    rest[receivers.origin] = False
    rest_index = rest.nonzero()[:, 0]
    object_rows = torch.arange(scene.captured.gaussians.count, merged.count)
    black = catchers.clear
    gaussians = concatenate([black, merged.select(rest_index), receivers.gaussians, merged.select(object_rows)])
    count = gaussians.count - len(object_rows)
    others = black.count + len(rest_index)
    ones, zeros = torch.ones(others, 3), torch.zeros(others, 3)
    replaced = [torch.full((one.gaussians.count,), one.source_lighting is not None) for one in objects]
    origin = torch.cat([receivers.origin[catchers.receiver], rest_index, receivers.origin, object_rows])
    order = origin.argsort(stable=True)
    return Relit(
        gaussians=gaussians.select(order),
        is_object=order >= count,
        origin=origin[order],
        shade=torch.cat([torch.ones(count, 3), *[one.shade for one in shadings]])[order],
        shadow=torch.cat([ones, on_scene.shadow, *[ratio.shadow for ratio in shadows.on_objects]])[order],
        bounce=torch.cat([zeros, on_scene.bounce, *[ratio.bounce for ratio in shadows.on_objects]])[order],
        slope=torch.cat([zeros, on_scene.slope, *[ratio.slope for ratio in shadows.on_objects]])[order],
        catcher_depth=F.pad(catchers.depth, (0, gaussians.count - black.count))[order],
        gloss=_gloss_layer(gaussians, shadings)[order],
        bands_replaced=torch.cat([torch.zeros(count, dtype=torch.bool), *replaced])[order],
        objects=tuple(one.gaussians for one in objects),
        light=scene.light,
        report=(_light_note(scene), *(note for one in objects for note in one.notes), *_shadow_notes(on_scene.shadow)),
        estimate=scene.estimate,
        received=tuple(one.received for one in shadings),
        prepared=tuple(objects),
    )


def _light_note(scene: SceneLight) -> Note:
    """What the light at the new place is, and whether most of it is a guess."""
    end = "." if scene.estimate is not None else ", as given."
    text = f"At the new place: {describe_light(scene.light, scene.captured.up)}{end}"
    certain = light_confidence(scene.light)
    if certain >= _MIN_CERTAIN:
        return Note(text)
    remedy = (
        f"Most of this light is a guess ({certain:.0%} of it was captured with a certain direction): photograph what "
        "surrounds the place, or give the light (--given-light)."
    )
    return Note(text, "warning", remedy)


def _shadow_notes(shadow: Float[Tensor, "n 3"]) -> tuple[Note, ...]:
    """A warning where no shadow is seen: what stands on something keeps light from its foot under any light.

    Args:
        shadow: Factors on the light of what surrounds the objects.
    """
    darkest = float(shadow.mean(1).sort().values[:_DARKEST].mean()) if len(shadow) else 1.0
    if darkest < _HARDLY_DARKER:
        return ()
    text = f"Hardly any shadow is seen: where it is darkest it takes {1 - darkest:.0%} of the light."
    return (Note(text, "warning", "Set the object down on what is under it, or set the sun by hand (--sun-through)."),)


def _shading(one: PreparedObject, scene: SceneLight, scene_visibility: Float[Tensor, "n k"]) -> _Shading:
    """The object's shading by the scene's light, ambient light included."""
    normals, opacities = one.normals.vectors, one.gaussians.opacities
    # the ambient light was captured at the place itself, where blockers are part of the panorama; so in the source
    shares = torch.where(torch.as_tensor(scene.samples.is_source), scene_visibility, torch.ones(()))
    shares = one.self_visibility * shares
    received = irradiance(scene.samples, normals, sample_visibility=shares)
    source = one.source_lighting
    if source is None:
        return _Shading(received, unknown_origin_ratio(received, opacities), None)
    settings = KNOWN_LIGHTS if scene.estimate is None and source.estimate is None else ShadeSettings()
    shade = shade_ratio(received, source.irradiance, opacities, settings=settings)
    if not bool(source.materials.glossy.any()):
        return _Shading(received, shade, None)
    scale = light_scale(received, source.irradiance, opacities, settings=settings)
    reflected = reflected_light(scene.light, scene.samples, shares).scaled(scale)
    return _Shading(received, shade, gloss_bands(one.gaussians, normals, source.materials, reflected, shade=shade))


def _gloss_layer(gaussians: Gaussians, shadings: Sequence[_Shading]) -> Float[Tensor, "m k 3"]:
    """The gloss layer of all m Gaussians, the objects' last; of degree 3 where something is glossy."""
    if all(one.gloss is None for one in shadings):
        return torch.zeros_like(gaussians.sh)
    count = spherical_harmonics.coefficient_count(spherical_harmonics.MAX_DEGREE)
    on_objects = [torch.zeros(len(one.shade), count, 3) if one.gloss is None else one.gloss for one in shadings]
    on_scene = torch.zeros(gaussians.count - sum(map(len, on_objects)), count, 3)
    return torch.cat([on_scene, *on_objects])


def pasted(composite: Composite, reason: str) -> Relit:
    """The copy-paste result, with the reason why there is no transfer."""
    gaussians, is_object = composite.merged()
    ones = torch.ones(gaussians.count, 3)
    return Relit(
        gaussians=gaussians,
        is_object=is_object,
        origin=torch.arange(gaussians.count),
        shade=ones,
        shadow=ones,
        bounce=torch.zeros_like(ones),
        slope=torch.zeros_like(ones),
        catcher_depth=torch.zeros(gaussians.count),
        gloss=torch.zeros_like(gaussians.sh),
        bands_replaced=torch.zeros(gaussians.count, dtype=torch.bool),
        objects=tuple(placed.in_target() for placed in composite.objects if placed.gaussians.count),
        light=None,
        report=(Note(reason, "warning"),),
    )
