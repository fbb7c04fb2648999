"""The change that an object makes to the light on the scene around it: shadow and bounce ratios per point.

Differential rendering (Debevec 1998): the ratio of irradiance with the object to irradiance without it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.samples import LightSamples
from splatgraft.relighting.normals import raised
from splatgraft.relighting.shading import irradiance
from splatgraft.relighting.shadows.occlusion import Occlusion, occluded_irradiance, occlusion_from_maps
from splatgraft.relighting.shadows.shadow_maps import (
    DepthMaps,
    Window,
    occluders_of,
    splat_depth_maps,
    thinned,
    visibility,
)

# shadow maps of objects and scenes; set by hand
_SOURCE_SIZE = 512  # pixels, a multiple of 16: width of a map of a source sample; set by hand
AMBIENT_SIZE = 256
"""Pixels, a multiple of 16: width of a map of an ambient sample; set by hand."""
_OBJECT_BIAS = (2.0, 1.0)
"""Pixels, for sources and for ambient light: nearer occluders are the receiver's own surface; set by hand."""
_SELF_BIAS = (2.5, 2.0)  # the same for an object's shadow on itself
_SCENE_BIAS = (2.5, 1.5)  # the same for the scene's shadow on itself and on objects
_SELF_AMBIENT = 1 / 3  # share of an ambient sample that still arrives where the object itself blocks it; set by hand
_SCENE_AMBIENT = 0.5  # share of an ambient sample that still arrives where the scene blocks it; set by hand
_BLOCKERS_AROUND = 1.5  # radii of the region within which the scene's Gaussians block light; set by hand
_MAX_ALBEDO = 0.8
"""Most albedo of an object: its unlit side is no brighter than the light on it allows, whatever light it was
captured in; fresh snow and white paint have about this."""
_NEAREST_SOURCE = 1.5  # object radii; a nearer source counts as this far from the object's middle; set by hand

# limits of shadow and bounce; set by hand
_MIN_CHANGE = 0.004
"""Share of light; smaller changes become 0, full from three times this on. Half an 8-bit step of a mid grey."""
DARKEST = 0.04
"""Share of light that every shadow leaves: light that no sample follows; set by hand."""
_NEAR_REACH = 3.5  # object radii within which ambient shadow and bounce are computed; set by hand
_WIDEST_CONE = 1.2  # radians; wider cones of a source reach as far aside as this one; set by hand


@dataclass(frozen=True)
class ObjectShadowMaps:
    """An object's depth maps from all samples of a light."""

    ambient_maps: DepthMaps
    """One per ambient sample."""
    occlusions: tuple[tuple[LightSamples, Occlusion, float], ...]
    """For the sources, if there are any, and for the ambient light: samples, occlusion, and bias in world units."""


def object_shadow_maps(gaussians: Gaussians, sphere: BoundingSphere, samples: LightSamples) -> ObjectShadowMaps:
    """Depth maps of an object, in the target's frame, for every light sample, with its colours for the bounce.

    Args:
        gaussians: The object.
        sphere: Its bounding sphere, which the maps cover.
        samples: Of the light at its place.
    """
    occluders = occluders_of(gaussians)
    sources, ambient = samples.of_sources, samples.of_ambient
    source_bias, ambient_bias = _OBJECT_BIAS
    occlusions = []

    def unlit(part: LightSamples) -> Float[Tensor, "k 3"]:
        facing = irradiance(samples, -part.directions, sample_visibility=torch.ones(len(part), len(samples)))
        return _MAX_ALBEDO * facing / math.pi

    if len(sources):
        both = torch.cat([sources.directions, -sources.directions])
        nearness = 1 / sources.distances.clamp_min(_NEAREST_SOURCE * sphere.radius)
        # from a near light the sphere's rim is seen farther out than its radius
        rim = sphere.radius / math.sqrt(1 - (float(nearness.max()) * sphere.radius) ** 2)
        window = Window(sphere.center, rim, frames_along(both), torch.cat([nearness, -nearness]))
        maps = splat_depth_maps(occluders, window, size=_SOURCE_SIZE, with_color=True)
        front = torch.arange(len(sources))
        occlusion = occlusion_from_maps(maps, front, front + len(front), brightest=unlit(sources))
        occlusions.append((sources, occlusion, source_bias * maps.texel))
    window = Window(center=sphere.center, radius=sphere.radius, frames=frames_along(ambient.directions))
    maps = splat_depth_maps(occluders, window, size=AMBIENT_SIZE, with_color=True)
    front = torch.arange(len(ambient))
    back = (front + len(front) // 2) % len(front)
    occlusion = occlusion_from_maps(maps, front, back, brightest=unlit(ambient))
    occlusions.append((ambient, occlusion, ambient_bias * maps.texel))
    return ObjectShadowMaps(maps, tuple(occlusions))


def self_visibility(
    maps: ObjectShadowMaps, gaussians: Gaussians, normals: Float[Tensor, "m 3"], samples: LightSamples
) -> Float[Tensor, "m k"]:
    """Visibility of every light sample from an object's own Gaussians, past the object itself.

    Args:
        maps: The object's.
        gaussians: The m Gaussians that receive light.
        normals: Unit, of their surfaces.
        samples: k samples, of the light that the maps were made for or of another one: maps of sources are made anew.

    Returns:
        Share of each sample that arrives, in [0, 1].
    """
    window, (source_bias, ambient_bias) = maps.ambient_maps.window, _SELF_BIAS
    points = raised(gaussians, normals)
    ambient = visibility(maps.ambient_maps, points, normals, bias=ambient_bias * maps.ambient_maps.texel)
    ambient = _SELF_AMBIENT + (1 - _SELF_AMBIENT) * ambient
    sources = samples.of_sources
    if not len(sources):
        return ambient
    lit = Window(center=window.center, radius=window.radius, frames=frames_along(sources.directions))
    fronts = splat_depth_maps(occluders_of(gaussians), lit, size=AMBIENT_SIZE, with_color=False)
    return torch.cat([visibility(fronts, points, normals, bias=source_bias * fronts.texel), ambient], 1)


@dataclass(frozen=True)
class SceneShadowMaps:
    """The scene's own depth maps around a place; they stay valid while objects move there."""

    region: BoundingSphere
    """What the maps cover."""
    source_maps: DepthMaps | None
    """One per source sample; None for a light without sources."""
    ambient_maps: DepthMaps
    """One per ambient sample."""


def scene_shadow_maps(scene: Gaussians, region: BoundingSphere, samples: LightSamples) -> SceneShadowMaps:
    """Depth maps of `scene` for every light sample. Only Gaussians in or near `region` block light."""
    maps: list[DepthMaps | None] = []
    reach = _BLOCKERS_AROUND * region.radius + 3 * scene.scales.max(1).values
    blockers = scene.select((scene.means - region.center).norm(dim=1) < reach)
    sizes = (_SOURCE_SIZE, AMBIENT_SIZE)
    for part, size in zip((samples.of_sources, samples.of_ambient), sizes, strict=True):
        window = Window(center=region.center, radius=region.radius, frames=frames_along(part.directions))
        nearest = -torch.tensor(part.blockers_within).clamp_max(region.radius)
        # Gaussians finer than a pixel of the map add no detail: a random part of them is enough
        occluders = occluders_of(thinned(blockers, width=2 * region.radius / size))
        splatted = splat_depth_maps(occluders, window, size=size, with_color=False, nearest=nearest)
        maps.append(splatted if len(part) else None)
    of_sources, of_ambient = maps
    assert of_ambient is not None
    return SceneShadowMaps(region=region, source_maps=of_sources, ambient_maps=of_ambient)


def scene_visibility(
    maps: SceneShadowMaps, points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]
) -> Float[Tensor, "m k"]:
    """Visibility of every light sample from `points` past the scene, so that existing shadows are not darkened twice.

    Args:
        maps: The scene's, for k samples.
        points: World units.
        normals: Unit, of the surface at each point.

    Returns:
        Share of each sample that arrives, in [0, 1].
    """
    source_bias, ambient_bias = _SCENE_BIAS
    ambient = visibility(maps.ambient_maps, points, normals, bias=ambient_bias * maps.ambient_maps.texel)
    ambient = _SCENE_AMBIENT + (1 - _SCENE_AMBIENT) * ambient
    if maps.source_maps is None:
        return ambient
    of_sources = visibility(maps.source_maps, points, normals, bias=source_bias * maps.source_maps.texel)
    return torch.cat([of_sources, ambient], 1)


@dataclass(frozen=True)
class SceneRatio:
    """Per receiver, the change that an object makes to the light on it."""

    shadow: Float[Tensor, "m 3"]
    """Share of linear light that is left, in (0, 1]; exactly 1 out of reach."""
    bounce: Float[Tensor, "m 3"]
    """Light from the object, as a share of the light without it."""
    slope: Float[Tensor, "m 3"]
    """View dependence of both, world axes: seen along the unit vector d, slope . d is added (grey)."""

    def strengthened(self, power: float) -> "SceneRatio":
        """With `power` times the logarithm of every shadow."""
        grey = self.shadow.mean(1, keepdim=True)
        return SceneRatio(self.shadow**power, self.bounce, power * grey ** (power - 1) * self.slope)


def scene_ratio(
    maps: ObjectShadowMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    sample_visibility: Float[Tensor, "m k"],
) -> SceneRatio:
    """Shadow and bounce of an object on a surface.

    Args:
        maps: The object's.
        points: World units.
        normals: Unit, of the surface at each point.
        sample_visibility: Share of each light sample that the scene lets through, in [0, 1].

    Returns:
        The ratios at `points`, with a slope of 0.
    """
    sums = (light_sums(maps, points, normals, sample_visibility=sample_visibility, sources=f) for f in (True, False))
    return ratio_from_sums(sum(sums, torch.zeros(3, len(points), 3)))


def light_sums(
    maps: ObjectShadowMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    sample_visibility: Float[Tensor, "m k"],
    sources: bool,
) -> Float[Tensor, "3 m 3"]:
    """Irradiance at `points` without the object, with it, and by its bounce: of the sources or of the ambient light."""
    total, column = torch.zeros(3, len(points), 3), 0
    for part, occlusion, bias in maps.occlusions:
        share = sample_visibility[:, column : column + len(part)].contiguous()
        column += len(part)
        if part.is_source[0] == sources:
            found = occluded_irradiance(occlusion, part, points, normals, sample_visibility=share, bias=bias)
            total = total + torch.stack(found)
    return total


def ratio_from_sums(sums: Float[Tensor, "3 m 3"]) -> SceneRatio:
    """Ratios from such sums of all light, limited and with small changes set to 0; the slope is 0."""
    without, with_object, bounce = sums
    total = without.clamp_min(1e-9)
    # an unlit point cannot get darker
    ratio = torch.where(without > 1e-8, with_object / total, 1).clamp(DARKEST, 1)
    lost = _soft_threshold(1 - ratio, _MIN_CHANGE)
    gained = _soft_threshold(torch.where(without > 1e-8, bounce / total, 0).clamp(0, 1), _MIN_CHANGE)
    return SceneRatio(shadow=1 - lost, bounce=gained, slope=torch.zeros_like(lost))


def _soft_threshold(change: Float[Tensor, "m 3"], least: float) -> Float[Tensor, "m 3"]:
    """`change` with values below `least` set to exactly 0, without a step: unchanged from three times `least` on."""
    strongest = change.max(1, keepdim=True).values
    return change * ((strongest - least) / (2 * least)).clamp(0, 1)


def reachable(
    points: Float[Tensor, "m 3"],
    sphere: BoundingSphere,
    samples: LightSamples,
    *,
    farthest: float,
    rims: Float[Tensor, "m"] | float = 0.0,
) -> Bool[Tensor, "m"]:
    """Points whose light an object may change: those near it, and those in the shadow cone of a source.

    Args:
        points: World units.
        sphere: The object's bounding sphere.
        samples: Of the light.
        farthest: World units from the object; no point beyond is reached.
        rims: World units; extent of what lies around each point.
    """
    away = points - sphere.center
    distance = away.norm(dim=1)
    near = distance - rims < _NEAR_REACH * sphere.radius
    parts = zip(samples.directions, samples.softness, samples.is_source, samples.distances, strict=True)
    for direction, softness, source, light_distance in parts:
        if source:
            along = -(away @ direction)
            aside = (distance**2 - along**2).clamp_min(0).sqrt()
            spread = torch.tan(softness.clamp_max(_WIDEST_CONE)) * (along + sphere.radius).clamp_min(0)
            # the shadow of a near light widens with the distance
            wider = 1 + along.clamp_min(0) / (light_distance - sphere.radius).clamp_min(0.5 * sphere.radius)
            near |= (along + rims > -sphere.radius) & (aside - rims < wider * (sphere.radius + spread))
    return near & (distance - rims < farthest)
