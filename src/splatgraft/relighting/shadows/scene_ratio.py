"""Shadow and bounce ratios: the change of the light at points of a scene by an object.

Differential rendering (Debevec 1998): the ratio of the irradiances with and without the object.

1. Splat depth maps from every light sample: of an object (`object_shadow_maps`), of the scene (`scene_shadow_maps`).
2. Look up visibility: past the scene (`scene_visibility`), past the object itself (`self_visibility`).
3. Sum the light of all samples with and without the object (`light_sums`), and divide (`ratio_from_sums`).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.relighting.light.samples import LightSamples
from splatgraft.relighting.normals import raised
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
_SOURCE_SIZE = 512  # pixels, a multiple of 16; width of a source sample's map
_AMBIENT_SIZE = 256  # the same for an ambient sample
_OBJECT_BIAS = (2.0, 1.0)  # pixels, for sources and ambient light; nearer occluders are the receiver's own surface
_SELF_BIAS = 2.5  # pixels, for an object's shadow on itself
_SCENE_BIAS = (2.5, 1.5)  # pixels, for the scene's shadow on itself and on objects
_SELF_AMBIENT = 1 / 3  # share of an ambient sample that arrives although the object itself blocks it: interreflection

# limits of shadow and bounce; set by hand
_MIN_CHANGE = 0.004  # share of light; half an 8-bit step of a mid grey. Smaller changes become 0
DARKEST = 0.04
"""Smallest share of light in a shadow: indirect light that no sample represents."""


@dataclass(frozen=True)
class ObjectShadowMaps:
    """An object's depth maps from all samples of a light."""

    sphere: BoundingSphere
    """The object's bounding sphere."""
    occlusions: tuple[tuple[LightSamples, Occlusion, float], ...]
    """Samples, occlusion, and bias in world units: of the sources, if there are any, then of the ambient light."""


def object_shadow_maps(
    gaussians: Gaussians, sphere: BoundingSphere, samples: LightSamples, *, radiance: Float[Tensor, "n 3"]
) -> ObjectShadowMaps:
    """Splat depth maps of an object for every light sample, with its colours for the bounce.

    Args:
        gaussians: The object, target's frame.
        sphere: The object's bounding sphere, which the maps cover.
        samples: Samples of the light at the object's place.
        radiance: Linear rgb that the Gaussians reflect in that light.
    """
    occluders = occluders_of(gaussians)
    sources, ambient = samples.of_sources, samples.of_ambient
    source_bias, ambient_bias = _OBJECT_BIAS
    occlusions = []
    if len(sources):
        both = torch.cat([sources.directions, -sources.directions])
        nearness = 1 / sources.distances.clamp_min(1.5 * sphere.radius)  # a nearer source counts as this far
        # seen from a near light, the sphere's rim lies farther out than its radius
        rim = sphere.radius / math.sqrt(1 - (float(nearness.max()) * sphere.radius) ** 2)
        window = Window(sphere.center, rim, frames_along(both), torch.cat([nearness, -nearness]))
        maps = splat_depth_maps(occluders, window, size=_SOURCE_SIZE, color=radiance)
        front = torch.arange(len(sources))
        occlusion = occlusion_from_maps(maps, front, front + len(front))
        occlusions.append((sources, occlusion, source_bias * maps.texel))
    window = Window(center=sphere.center, radius=sphere.radius, frames=frames_along(ambient.directions))
    maps = splat_depth_maps(occluders, window, size=_AMBIENT_SIZE, color=radiance)
    front = torch.arange(len(ambient))
    back = (front + len(front) // 2) % len(front)
    occlusions.append((ambient, occlusion_from_maps(maps, front, back), ambient_bias * maps.texel))
    return ObjectShadowMaps(sphere, tuple(occlusions))


def self_visibility(
    gaussians: Gaussians, sphere: BoundingSphere, normals: Float[Tensor, "m 3"], samples: LightSamples
) -> Float[Tensor, "m k"]:
    """Compute the visibility of every sample of a light from an object's own Gaussians, past the object itself.

    Args:
        gaussians: The m Gaussians of the object.
        sphere: The object's bounding sphere.
        normals: Unit normals of their surfaces.
        samples: The k samples of the light.

    Returns:
        Share of each sample that arrives, in [0, 1].
    """
    window = Window(center=sphere.center, radius=sphere.radius, frames=frames_along(samples.directions))
    maps = splat_depth_maps(occluders_of(gaussians), window, size=_AMBIENT_SIZE)
    visible = visibility(maps, raised(gaussians, normals), normals, bias=_SELF_BIAS * maps.texel)
    through = _SELF_AMBIENT + (1 - _SELF_AMBIENT) * visible
    found = torch.where(torch.tensor(samples.is_source), visible, through)
    return found * _past_relief(gaussians, normals, samples) if isinstance(gaussians, KnownSurface) else found


def _past_relief(surface: KnownSurface, normals: Float[Tensor, "m 3"], samples: LightSamples) -> Float[Tensor, "m k"]:
    """Compute the share of each sample that passes the relief of a normal map; 1 where the normal is that of the plane.

    The relief is a GGX surface with alpha^2 = tan^2(tilt of the normal) / 8, which blocks light along the plane and all
    light from below (Estevez et al. 2019).
    """
    axis = rotation_from_quaternion(surface.quaternions)[:, :, 2]
    aligned = (axis * normals).sum(1)  # cosine of the tilt, negative for an axis that points inwards
    rough = (1 / aligned.abs().clamp(0.1, 1) ** 2 - 1) / 8
    cosine = (aligned.sign()[:, None] * axis @ samples.directions.T).clamp(1e-4, 1)
    return 2 / (1 + (1 + rough[:, None] * (1 / cosine**2 - 1)).sqrt())


@dataclass(frozen=True)
class SceneShadowMaps:
    """Depth maps of the scene around a place; they stay valid while objects move there."""

    region: BoundingSphere
    """The sphere that the maps cover."""
    source_maps: DepthMaps | None
    """Depth maps, one per source sample; None for a light without sources."""
    ambient_maps: DepthMaps
    """Depth maps, one per ambient sample."""

    def covers(self, points: Float[Tensor, "m 3"]) -> Bool[Tensor, "m"]:
        """Select points in the region, or behind it as seen from a source, where that source's map shows them, too."""
        away = points - self.region.center
        found = away.norm(dim=1) < self.region.radius
        if self.source_maps is not None:
            for direction in self.source_maps.window.directions:
                found |= _from_axis(away, direction) < self.region.radius
        return found


def scene_shadow_maps(
    scene: Gaussians, region: BoundingSphere, samples: LightSamples, *, radius: float
) -> SceneShadowMaps:
    """Splat depth maps of a scene for every light sample.

    Args:
        scene: Only Gaussians near the region, and those behind it where umbras reach them, block light.
        region: The sphere that the maps cover.
        samples: Samples of the light.
        radius: Radius of the largest object, world units.
    """
    maps: list[DepthMaps | None] = []
    reach = 1.5 * region.radius + 3 * scene.scales.max(1).values
    away, sources = scene.means - region.center, samples.of_sources
    near = away.norm(dim=1) < reach
    in_beam = near.clone()
    for direction, length in zip(sources.directions, umbra_lengths(sources, radius), strict=True):
        along = -(away @ direction)
        in_beam |= (along > 0) & (along < length) & (_from_axis(away, direction) < reach)
    parts = ((sources, _SOURCE_SIZE, in_beam), (samples.of_ambient, _AMBIENT_SIZE, near))
    for part, size, is_blocker in parts:
        blockers = scene.with_sh_degree(0).select(is_blocker)
        window = Window(center=region.center, radius=region.radius, frames=frames_along(part.directions))
        nearest = -torch.tensor(part.blockers_within).clamp_max(region.radius)
        # Gaussians finer than a pixel of the map add no detail, so a random part of them is enough
        occluders = occluders_of(thinned(blockers, width=2 * region.radius / size))
        splatted = splat_depth_maps(occluders, window, size=size, nearest=nearest)
        maps.append(splatted if len(part) else None)
    of_sources, of_ambient = maps
    assert of_ambient is not None
    return SceneShadowMaps(region=region, source_maps=of_sources, ambient_maps=of_ambient)


def scene_visibility(
    maps: SceneShadowMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    heights: Float[Tensor, "m"] | None = None,
) -> Float[Tensor, "m k"]:
    """Look up the visibility of every light sample from `points` past the scene.

    This keeps an object from darkening the scene's existing shadows again.

    Args:
        maps: The scene's shadow maps for k samples.
        points: World units.
        normals: Unit normals of the surface at each point.
        heights: Heights of the surface's layer over the points, as for `visibility`.

    Returns:
        Share of each sample that arrives, in [0, 1].
    """
    source_bias, ambient_bias = _SCENE_BIAS
    bias = ambient_bias * maps.ambient_maps.texel
    ambient = visibility(maps.ambient_maps, points, normals, bias=bias, heights=heights)
    if maps.source_maps is None:
        return ambient
    bias = source_bias * maps.source_maps.texel
    of_sources = visibility(maps.source_maps, points, normals, bias=bias, heights=heights)
    return torch.cat([of_sources, ambient], 1)


@dataclass(frozen=True)
class SceneRatio:
    """Change of the light on m receivers by an object."""

    shadow: Float[Tensor, "m 3"]
    """Share of linear light that the object leaves, in (0, 1]; exactly 1 out of reach."""
    bounce: Float[Tensor, "m 3"]
    """Light reflected by the object, over the light without the object."""
    slope: Float[Tensor, "m 3"]
    """View dependence, world axes: slope . d is added to both in all channels for the unit view direction d."""

    def select(self, which: Tensor) -> "SceneRatio":
        """Select receivers by a mask or by indices."""
        return SceneRatio(shadow=self.shadow[which], bounce=self.bounce[which], slope=self.slope[which])

    def strengthened(self, power: float) -> "SceneRatio":
        """Multiply the logarithm of every shadow by `power`."""
        grey = self.shadow.mean(1, keepdim=True)
        return SceneRatio(self.shadow**power, self.bounce, power * grey ** (power - 1) * self.slope)


def scene_ratio(
    maps: ObjectShadowMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    sample_visibility: Float[Tensor, "m k"],
) -> SceneRatio:
    """Compute shadow and bounce of an object on a surface.

    Args:
        maps: The object's shadow maps.
        points: World units.
        normals: Unit normals of the surface at each point.
        sample_visibility: Share of each light sample that the scene lets through, in [0, 1].

    Returns:
        Ratios at `points`, with a slope of 0.
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
    """Sum the irradiance at `points` by the sources or by the ambient light.

    Args:
        maps: The object's shadow maps.
        points: World units.
        normals: Unit normals of the surface at each point.
        sample_visibility: Share of each light sample that the scene lets through, in [0, 1].
        sources: True for the sources, False for the ambient light.

    Returns:
        Linear rgb irradiance without the object, with it, and by its bounce.
    """
    total, column = torch.zeros(3, len(points), 3), 0
    for part, occlusion, bias in maps.occlusions:
        share = sample_visibility[:, column : column + len(part)].contiguous()
        column += len(part)
        if part.is_source[0] == sources:
            found = occluded_irradiance(occlusion, part, points, normals, sample_visibility=share, bias=bias)
            total = total + torch.stack(found)
    return total


def ratio_from_sums(sums: Float[Tensor, "3 m 3"]) -> SceneRatio:
    """Compute ratios from the sums of all light (`light_sums`), limited and without small changes; the slope is 0."""
    without, with_object, bounce = sums
    total = without.clamp_min(1e-9)
    # an unlit point cannot get darker
    ratio = torch.where(without > 1e-8, with_object / total, 1).clamp(DARKEST, 1)
    lost = _soft_threshold(1 - ratio, _MIN_CHANGE)
    gained = _soft_threshold(torch.where(without > 1e-8, bounce / total, 0).clamp(0, 1), _MIN_CHANGE)
    return SceneRatio(shadow=1 - lost, bounce=gained, slope=torch.zeros_like(lost))


def _soft_threshold(change: Float[Tensor, "m 3"], least: float) -> Float[Tensor, "m 3"]:
    """Set changes below `least` to exactly 0, and fade them in up to three times `least`."""
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
    """Select points whose light an object may change: those near it, and those in the shadow cone of a source.

    Args:
        points: World units.
        sphere: The object's bounding sphere.
        samples: Samples of the light.
        farthest: World units from the object; a cone ends there, or at the end of its umbra (`umbra_lengths`).
        rims: Extent of the Gaussian around each point, world units.
    """
    away = points - sphere.center
    distance = away.norm(dim=1)
    inside = distance - rims < farthest
    reached = inside & (distance - rims < 3.5 * sphere.radius)  # reach of ambient shadow and bounce; set by hand
    sources = samples.of_sources
    lengths = umbra_lengths(sources, sphere.radius)
    parts = zip(sources.directions, sources.softness, sources.distances, lengths, strict=True)
    for direction, softness, light_distance, length in parts:
        along = -(away @ direction)
        aside = _from_axis(away, direction)
        spread = torch.tan(softness.clamp_max(1.2)) * (along + sphere.radius).clamp_min(0)
        # the shadow of a near light widens with the distance
        wider = 1 + along.clamp_min(0) / (light_distance - sphere.radius).clamp_min(0.5 * sphere.radius)
        in_cone = (along + rims > -sphere.radius) & (aside - rims < wider * (sphere.radius + spread))
        reached |= in_cone & (inside | (along - rims < length))
    return reached


def _from_axis(away: Float[Tensor, "m 3"], direction: Float[Tensor, "3"]) -> Float[Tensor, "m"]:
    """Compute the distance of points from the line through the origin along a unit direction."""
    return torch.linalg.cross(away, direction[None]).norm(dim=1)


def umbra_lengths(sources: LightSamples, radius: float) -> Float[Tensor, "k"]:
    """Compute how far the umbra of a ball reaches under each source, world units; 0 under near lights.

    Args:
        sources: k samples of sources.
        radius: The ball's radius, world units.
    """
    narrowest = math.radians(0.27)  # of the sun
    lengths = radius / torch.tan(sources.softness.clamp(narrowest, 1.2))
    return torch.where(torch.isinf(sources.distances), lengths, 0.0)
