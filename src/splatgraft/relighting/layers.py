"""Result of a light transfer: a composite with shading, shadow, bounce and gloss as layers to weight and bake."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.compositing.composite import Composite
from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, KnownSurface, concatenate
from splatgraft.core.images import LUMINANCE, linear_from_srgb, srgb_from_linear
from splatgraft.core.splitting import split_wide_around
from splatgraft.relighting.cast_shadows import Shadows
from splatgraft.relighting.light.description import describe_light
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.light import Light, light_confidence
from splatgraft.relighting.light.panorama import NEAREST, radiance_change
from splatgraft.relighting.light.samples import sample_light
from splatgraft.relighting.materials import gloss_bands, reflected_light
from splatgraft.relighting.prepared_object import PreparedObject
from splatgraft.relighting.scene_light import SceneLight
from splatgraft.relighting.shading import (
    KNOWN_LIGHTS,
    KNOWN_SURFACES,
    LEVEL_ERROR_STOPS,
    SKY_LEVEL_ERROR_STOPS,
    ShadeSettings,
    apply_gain,
    irradiance,
    light_scale,
    shade_ratio,
    unknown_origin_ratio,
)
from splatgraft.runtime.note import Note
from splatgraft.runtime.notebook import draw_in_notebook

_MIN_SLOPE = 1e-6  # slope of a ratio over view directions; smaller ones are invisible, and below 1e-20 squares are 0


@dataclass(frozen=True)
class LayerWeights:
    """Weights of the layers in a baked scene, and an exposure.

    A weight of 0 omits a layer, 1 is physically right, more exaggerates.
    """

    shade: float = 1.0
    """The object's own light and dark sides."""
    shadow: float = 1.0
    """The object's shadow on its surroundings."""
    bounce: float = 1.0
    """Light that the object reflects onto its surroundings."""
    gloss: float = 1.0
    """Reflections on the object."""
    tint: float = 1.0
    """Change of colour within the object's shade; the brightness stays."""
    exposure: float = 0.0
    """Extra brightness of the object, except of its reflections, stops; 0 is physically right."""
    warmth: float = 0.0
    """Extra red over blue on the object at the same brightness, stops; 0 is physically right."""


@dataclass(frozen=True)
class Relit:
    """A composite of m Gaussians with its light transfer in layers."""

    gaussians: Gaussians
    """Gaussians without any layer: the target's, then the objects'; large ones in a shadow are split."""
    is_object: Bool[Tensor, "m"]
    """Whether each Gaussian belongs to an object."""
    origin: Int[Tensor, "m"]
    """Position of each Gaussian, or of its whole, in `Composite.merged()`."""
    shade: Float[Tensor, "m 3"]
    """Factor on linear rgb; 1 outside the objects."""
    shadow: Float[Tensor, "m 3"]
    """Factor on linear rgb in (0, 1]; 1 without a shadow."""
    bounce: Float[Tensor, "m 3"]
    """Light reflected by objects over the light without them, at least 0; added to `shadow`."""
    slope: Float[Tensor, "m 3"]
    """View dependence, world axes: its product with the unit vector from the camera is added to shadow and bounce."""
    gloss: Float[Tensor, "m k 3"]
    """Coefficients that are added to the harmonics after shading."""
    bands_replaced: Bool[Tensor, "m"]
    """Whether `gloss` replaces a Gaussian's own higher bands, which show reflections of the old light."""
    objects: tuple[Gaussians, ...]
    """Placed objects, target's frame."""
    light: Light | None
    """Light at the objects' place; None if there was no transfer."""
    report: tuple[Note, ...]
    """Lights that were found, their uncertainty, and reasons for steps that were not done."""
    estimate: EstimatedLight | None = None
    """Evidence for `light`; None if the light was given or there was no transfer."""
    received: tuple[Float[Tensor, "n 3"], ...] = ()
    """Linear rgb irradiance on the Gaussians of each object at the new place."""
    prepared: tuple[PreparedObject, ...] = ()
    """Normals and old light of each object; empty if there was no transfer."""

    def __repr__(self) -> str:
        count, own = self.gaussians.count, int(self.is_object.sum())
        return f"Relit({count:,} Gaussians, {own:,} of objects, {self.light or 'no light'})"

    _repr_png_ = draw_in_notebook

    def bake(self, weights: LayerWeights = LayerWeights()) -> tuple[Gaussians, Bool[Tensor, "b"]]:
        """Apply the layers, and split wide Gaussians of the target around the objects, as `Composite.bake` does.

        Args:
            weights: Weight of each layer.

        Returns:
            The scene to write or to draw, and whether each of its Gaussians belongs to an object.
        """
        return split_wide_around(self.shaded(weights), self.is_object, self.objects)

    def shaded(self, weights: LayerWeights = LayerWeights()) -> Gaussians:
        """Apply the layers to the m Gaussians, in the order of `gaussians`; unchanged ones keep every bit."""
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
        return replace(self.gaussians, sh=sh)

    def ratio(self, weights: LayerWeights = LayerWeights()) -> Float[Tensor, "m 3"]:
        """Compute the factor on linear rgb of shade, tint, exposure, warmth, shadow and bounce together."""
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
    """Raise the chromaticity of a factor on linear rgb to the power of `weight`, at the same luminance."""
    luminance = (factor @ LUMINANCE)[:, None].clamp_min(1e-6)
    chroma = (factor / luminance).clamp_min(1e-6) ** weight
    changed = luminance * chroma / (chroma @ LUMINANCE)[:, None]
    # grey factors keep every bit
    return torch.where((factor == factor[:, :1]).all(1, keepdim=True), factor, changed)


def _srgb_slope(
    srgb: Float[Tensor, "n 3"], ratio: Float[Tensor, "n 3"], slope: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3 3"]:
    """Compute slopes of sRGB colours along the world's axes (second dimension) from a slope of linear light's `ratio`.

    The slope is the secant between both ends of the view directions. It is limited so that neither end is black or
    brighter than without a shadow.
    """
    length = slope.norm(dim=1, keepdim=True).clamp_min(_MIN_SLOPE)
    most = torch.minimum(0.9 * ratio, (1 - ratio).clamp_min(0))  # a tenth of the light stays; set by hand
    change = torch.minimum(length, most).clamp_min(_MIN_SLOPE)
    linear = linear_from_srgb(srgb.clamp(0, 1))
    high, low = (srgb_from_linear(linear * (ratio + sign * change)) for sign in (1, -1))
    return (slope / length)[:, :, None] * (0.5 * (high - low))[:, None]


@dataclass(frozen=True)
class _Shading:
    """Shading of an object of n Gaussians at its new place."""

    received: Float[Tensor, "n 3"]
    """Linear rgb irradiance."""
    shade: Float[Tensor, "n 3"]
    """Factor on linear rgb."""
    gloss: Float[Tensor, "n 16 3"] | None
    """Coefficients of the gloss layer; None for a matt object."""


def assemble_layers(merged: Gaussians, scene: SceneLight, objects: Sequence[PreparedObject], shadows: Shadows) -> Relit:
    """Shade the objects, and sort all layers in the order of the merged composite, pieces at the place of their whole.

    Args:
        merged: Result of `Composite.merged`.
        scene: The light at the objects' place.
        objects: All objects that have Gaussians.
        shadows: Shadows under that light.
    """
    receivers, on_scene = shadows.receivers, shadows.on_scene
    rest = torch.ones(scene.captured.gaussians.count, dtype=torch.bool)
    rest[receivers.origin] = False
    rest_index = rest.nonzero()[:, 0]
    object_rows = torch.arange(scene.captured.gaussians.count, merged.count)
    around = concatenate([merged.select(rest_index), receivers.gaussians])
    change = torch.cat([torch.zeros(len(rest_index), 3), on_scene.shadow + on_scene.bounce - 1])
    shadings = [
        _shading(one, _with_shadowed_surroundings(scene, around, change, one), shares)
        for one, shares in zip(objects, shadows.scene_visibility, strict=True)
    ]
    gaussians = concatenate([around, merged.select(object_rows)])
    count = gaussians.count - len(object_rows)
    ones, zeros = torch.ones(len(rest_index), 3), torch.zeros(len(rest_index), 3)
    replaced = [torch.full((one.gaussians.count,), one.source_lighting is not None) for one in objects]
    origin = torch.cat([rest_index, receivers.origin, object_rows])
    order = origin.argsort(stable=True)
    return Relit(
        gaussians=gaussians.select(order),
        is_object=order >= count,
        origin=origin[order],
        shade=torch.cat([torch.ones(count, 3), *[one.shade for one in shadings]])[order],
        shadow=torch.cat([ones, on_scene.shadow, *[ratio.shadow for ratio in shadows.on_objects]])[order],
        bounce=torch.cat([zeros, on_scene.bounce, *[ratio.bounce for ratio in shadows.on_objects]])[order],
        slope=torch.cat([zeros, on_scene.slope, *[ratio.slope for ratio in shadows.on_objects]])[order],
        gloss=_gloss_layer(gaussians, shadings)[order],
        bands_replaced=torch.cat([torch.zeros(count, dtype=torch.bool), *replaced])[order],
        objects=tuple(one.gaussians for one in objects),
        light=scene.light,
        report=(
            _light_note(scene),
            *(note for one in objects for note in one.notes),
            *_level_notes(scene, objects),
            *_shadow_notes(on_scene.shadow),
        ),
        estimate=scene.estimate,
        received=tuple(one.received for one in shadings),
        prepared=tuple(objects),
    )


def _light_note(scene: SceneLight) -> Note:
    """Describe the light at the new place, with a warning if most of it is a guess."""
    is_clear = scene.estimate is not None and scene.estimate.sky is not None
    place = "At the new place, under a clear sky" if is_clear else "At the new place"
    if scene.estimate is not None and scene.estimate.is_shaded:
        place += ", in the shade of something that was not photographed"
    end = "." if scene.estimate is not None else ", as given."
    text = f"{place}: {describe_light(scene.light, scene.captured.up)}{end}"
    # what no camera saw of a clear sky is no guess
    certain = light_confidence(replace(scene.light, coverage=1.0) if is_clear else scene.light)
    if certain >= 0.5:
        return Note(text)
    remedy = (
        f"Most of this light is a guess ({certain:.0%} of it was captured with a certain direction), so shading and "
        "shadows may be wrong: photograph the surroundings of the place, or give the light (--given-light)."
    )
    return Note(text, "warning", remedy)


def _level_notes(scene: SceneLight, objects: Sequence[PreparedObject]) -> tuple[Note, ...]:
    """Describe the uncertain level of an estimated light, which meshes show, because their albedo is absolute."""
    if scene.estimate is None or not any(isinstance(one.gaussians, KnownSurface) for one in objects):
        return ()
    error = LEVEL_ERROR_STOPS if scene.estimate.sky is None else SKY_LEVEL_ERROR_STOPS
    text = f"A mesh is as bright as it should be to a standard error of {error:.1f} stops."
    return (Note(text, "said", "Compare it with things of similar colour beside it; exposure corrects it."),)


def _shadow_notes(shadow: Float[Tensor, "n 3"]) -> tuple[Note, ...]:
    """Warn if no shadow is visible, because an object that stands on a surface shades its foot under any light.

    Args:
        shadow: Factors on the light of the n receivers.
    """
    darkest = float(shadow.mean(1).sort().values[:20].mean()) if len(shadow) else 1.0
    if darkest < 0.85:
        return ()
    text = f"Hardly any shadow is visible: even the darkest takes only {1 - darkest:.0%} of the light."
    return (Note(text, "warning", "Set the object down on its support, or set the sun by hand (--sun-through)."),)


def _with_shadowed_surroundings(
    scene: SceneLight, around: Gaussians, change: Float[Tensor, "m 3"], one: PreparedObject
) -> SceneLight:
    """Change the ambient light of an object by the shadow and the bounce that it sees on its surroundings.

    Args:
        scene: The light at the objects' place without them.
        around: The m Gaussians of the scene.
        change: Relative change of their linear rgb by all objects.
        one: The object.
    """
    sphere = one.sphere
    seen = radiance_change(around, change, sphere.center, nearest=NEAREST * sphere.radius)
    light = replace(scene.light, ambient=scene.light.ambient + seen)
    return replace(scene, light=light, samples=sample_light(light))


def _shading(one: PreparedObject, scene: SceneLight, scene_visibility: Float[Tensor, "n k"]) -> _Shading:
    """Shade an object by the scene's light, ambient light included."""
    normals, opacities = one.normals.vectors, one.gaussians.opacities
    # the scene blocks no ambient light: it is part of the panorama that was captured at the place; as for the source
    shares = torch.where(torch.as_tensor(scene.samples.is_source), scene_visibility, torch.ones(()))
    shares = one.self_visibility * shares
    received = irradiance(scene.samples, normals, sample_visibility=shares)
    source = one.source_lighting
    if source is None:
        return _Shading(received, unknown_origin_ratio(received, opacities), None)
    if isinstance(one.gaussians, KnownSurface):
        settings = KNOWN_SURFACES
    else:
        settings = KNOWN_LIGHTS if scene.estimate is None and source.estimate is None else ShadeSettings()
    shade = shade_ratio(received, source.irradiance, opacities, settings=settings)
    if not bool(source.materials.glossy.any()):
        return _Shading(received, shade, None)
    scale = light_scale(received, source.irradiance, opacities, settings=settings)
    reflected = reflected_light(scene.light, scene.samples, shares).scaled(scale)
    return _Shading(received, shade, gloss_bands(one.gaussians, normals, source.materials, reflected, shade=shade))


def _gloss_layer(gaussians: Gaussians, shadings: Sequence[_Shading]) -> Float[Tensor, "m k 3"]:
    """Assemble the gloss layer of all m Gaussians, the objects' last; its degree is 0 if nothing is glossy, else 3."""
    if all(one.gloss is None for one in shadings):
        return _no_gloss(gaussians)
    count = spherical_harmonics.coefficient_count(spherical_harmonics.MAX_DEGREE)
    on_objects = [torch.zeros(len(one.shade), count, 3) if one.gloss is None else one.gloss for one in shadings]
    on_scene = torch.zeros(gaussians.count - sum(map(len, on_objects)), count, 3)
    return torch.cat([on_scene, *on_objects])


def _no_gloss(gaussians: Gaussians) -> Float[Tensor, "m 1 3"]:
    return torch.zeros_like(gaussians.sh[:, :1])


def pasted(composite: Composite, reason: str) -> Relit:
    """Return the copy-paste result, with the reason for the missing transfer in its report."""
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
        gloss=_no_gloss(gaussians),
        bands_replaced=torch.zeros(gaussians.count, dtype=torch.bool),
        objects=tuple(placed.in_target() for placed in composite.objects if placed.gaussians.count),
        light=None,
        report=(Note(reason, "warning"),),
    )
