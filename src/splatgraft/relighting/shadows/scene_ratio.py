"""What an object does to the light on the scene around it: shadow and bounce ratios per Gaussian.

Debevec 1998: S = (light with the object) / (light without it). Knows nothing about files, and not where light is from.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shading.normals import raised
from splatgraft.relighting.shadows.light_sampling import ambient_pairs, source_pairs
from splatgraft.relighting.shadows.occlusion import LightSamples, Occlusion, cast, occlusion_from_maps
from splatgraft.relighting.shadows.shadow_maps import (
    DepthMaps,
    Window,
    occluders_of,
    splat_depth_maps,
    thinned,
    visibility,
)

SOURCE_SIZE, AMBIENT_SIZE = 512, 256
_DEAD_ZONE = 0.004  # changes of linear light below half an 8-bit step of a mid grey are left out
_DARKEST = 0.04  # no shadow is darker: there is always some light that no map follows


@dataclass(frozen=True)
class ObjectShadowMaps:
    """An object as all bundles of a light see it."""

    ambient_maps: DepthMaps
    """One per ambient bundle; opposites are each other's back."""
    occlusions: tuple[tuple[LightSamples, Occlusion, float], ...]
    """For sources, if any, and ambient light: the bundles, what the object blocks of them, and the depth bias."""


def object_shadow_maps(gaussians: Gaussians, ball: BoundingSphere, beams: LightSamples) -> ObjectShadowMaps:
    """Depth maps of an object (already in the world) for every bundle, with its colours for the bounce."""
    occluders = occluders_of(gaussians)
    sources, front, back = source_pairs(beams)
    around, around_front, around_back = ambient_pairs(beams)
    occlusions = []
    if len(sources):
        both = torch.cat([sources.directions, -sources.directions])
        window = Window(center=ball.center, radius=ball.radius, frames=frames_along(both))
        maps = splat_depth_maps(occluders, window, size=SOURCE_SIZE, with_color=True)
        occlusions.append((sources, occlusion_from_maps(maps, front, back), 2 * maps.texel))
    window = Window(center=ball.center, radius=ball.radius, frames=frames_along(around.directions))
    maps = splat_depth_maps(occluders, window, size=AMBIENT_SIZE, with_color=True)
    occlusions.append((around, occlusion_from_maps(maps, around_front, around_back), maps.texel))
    return ObjectShadowMaps(maps, tuple(occlusions))


def self_visibility(
    maps: ObjectShadowMaps, gaussians: Gaussians, normals: Float[Tensor, "m 3"], beams: LightSamples
) -> Float[Tensor, "m k"]:
    """Share of every bundle of `beams` that an object lets through to its own Gaussians.

    `beams` may belong to another light than the maps were made for: its sources are then mapped anew. An ambient
    bundle that is blocked still brings a third: light between the object's own parts.
    """
    window = maps.ambient_maps.window
    points = raised(gaussians, normals)
    around = visibility(maps.ambient_maps, points, normals, bias=2 * maps.ambient_maps.texel)
    around = 1 / 3 + 2 / 3 * around
    sources, _, _ = source_pairs(beams)
    if not len(sources):
        return around
    lit = Window(center=window.center, radius=window.radius, frames=frames_along(sources.directions))
    fronts = splat_depth_maps(occluders_of(gaussians), lit, size=AMBIENT_SIZE, with_color=False)
    return torch.cat([visibility(fronts, points, normals, bias=2.5 * fronts.texel), around], 1)


@dataclass(frozen=True)
class SceneShadowMaps:
    """The scene's own depth maps around a place: they do not change when an object moves there."""

    region: BoundingSphere
    """Where they hold."""
    source_maps: DepthMaps | None
    """One per bundle of a source; None without sources."""
    ambient_maps: DepthMaps
    """One per ambient bundle."""


def scene_shadow_maps(scene: Gaussians, region: BoundingSphere, beams: LightSamples) -> SceneShadowMaps:
    """Depth maps of `scene` for every bundle. Only what is in the region blocks: the light is from beyond it."""
    maps: list[DepthMaps | None] = []
    near = (scene.means - region.center).norm(dim=1) < 1.5 * region.radius + 3 * scene.scales.max(1).values
    blockers = scene.select(near)
    for part, size in ((source_pairs(beams)[0], SOURCE_SIZE), (ambient_pairs(beams)[0], AMBIENT_SIZE)):
        window = Window(center=region.center, radius=region.radius, frames=frames_along(part.directions))
        nearest = -torch.tensor(part.blockers_within).clamp_max(region.radius)
        # what is finer than a pixel of the map tells no more than a sample of it
        occluders = occluders_of(thinned(blockers, width=2 * region.radius / size))
        seen = splat_depth_maps(occluders, window, size=size, with_color=False, nearest=nearest)
        maps.append(seen if len(part) else None)
    of_sources, of_ambient = maps
    assert of_ambient is not None
    return SceneShadowMaps(region=region, source_maps=of_sources, ambient_maps=of_ambient)


def scene_visibility(
    maps: SceneShadowMaps, points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]
) -> Float[Tensor, "m k"]:
    """Share of every bundle that the scene itself lets through to `points`: the guard against darkening twice.

    An ambient bundle that is blocked still brings half: the light of the blocker itself.
    """
    around = 0.5 + 0.5 * visibility(maps.ambient_maps, points, normals, bias=1.5 * maps.ambient_maps.texel)
    if maps.source_maps is None:
        return around
    return torch.cat([visibility(maps.source_maps, points, normals, bias=2.5 * maps.source_maps.texel), around], 1)


@dataclass(frozen=True)
class SceneRatio:
    """Per receiver, the change that an object makes to the light on it."""

    shadow: Float[Tensor, "m 3"]
    """Share of linear light left, in (0, 1]; exactly 1 out of reach."""
    bounce: Float[Tensor, "m 3"]
    """Light from the object, as a share of the light before."""
    slope: Float[Tensor, "m 3"]
    """Change of both by the direction of view, world axes: seen along the unit vector d, slope . d is added (grey)."""


def scene_ratio(
    maps: ObjectShadowMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    arrives: Float[Tensor, "m k"],
) -> SceneRatio:
    """Ratio at `points`; `arrives` is the share of each bundle that the scene lets through."""
    sums = (light_sums(maps, points, normals, arrives=arrives, sources=flag) for flag in (True, False))
    return ratio_of(sum(sums, torch.zeros(3, len(points), 3)))


def light_sums(
    maps: ObjectShadowMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    arrives: Float[Tensor, "m k"],
    sources: bool,
) -> Float[Tensor, "3 m 3"]:
    """Irradiance at `points` before, after and by bounce, of the sources' bundles or of the ambient ones."""
    total, column = torch.zeros(3, len(points), 3), 0
    for part, occlusion, bias in maps.occlusions:
        share = arrives[:, column : column + len(part)].contiguous()
        column += len(part)
        if part.is_source[0] == sources:
            total = total + torch.stack(cast(occlusion, part, points, normals, arrives=share, bias=bias))
    return total


def ratio_of(sums: Float[Tensor, "3 m 3"]) -> SceneRatio:
    """What such sums come to as a change."""
    before, after, bounce = sums
    total = before.clamp_min(1e-9)
    # where no light was, none can be taken
    ratio = torch.where(before > 1e-8, after / total, 1).clamp(_DARKEST, 1)
    lost = _beyond_dead_zone(1 - ratio)
    gained = _beyond_dead_zone(torch.where(before > 1e-8, bounce / total, 0).clamp(0, 1))
    return SceneRatio(shadow=1 - lost, bounce=gained, slope=torch.zeros_like(lost))


def _beyond_dead_zone(change: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """`change` with small values taken to exactly 0, without a step: full from three times the zone on."""
    strongest = change.max(1, keepdim=True).values
    return change * ((strongest - _DEAD_ZONE) / (2 * _DEAD_ZONE)).clamp(0, 1)


def reachable(
    points: Float[Tensor, "m 3"],
    ball: BoundingSphere,
    beams: LightSamples,
    *,
    farthest: float,
    rims: Float[Tensor, "m"] | float = 0.0,
) -> Bool[Tensor, "m"]:
    """Points within `farthest` of the object that some bundle's shadow cone may touch, or come nearer than `rims`."""
    away = points - ball.center
    distance = away.norm(dim=1)
    near = distance - rims < 3.5 * ball.radius
    for direction, softness, source in zip(beams.directions, beams.softness, beams.is_source, strict=True):
        if source:
            along = -(away @ direction)
            aside = (distance**2 - along**2).clamp_min(0).sqrt()
            spread = torch.tan(softness.clamp_max(1.2)) * (along + ball.radius).clamp_min(0)
            near |= (along + rims > -ball.radius) & (aside - rims < ball.radius + spread)
    return near & (distance - rims < farthest)
