"""The scene around the place of an object, prepared once: its normals, light and depth maps. Knows no objects.

What is kept stays valid while objects move within the inner half of the region; then it is made anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import estimate_lights, panorama_at
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama_sources import light_from_panorama
from splatgraft.relighting.light.sun_visibility import observed_sun_visibility
from splatgraft.relighting.shading.irradiance import irradiance
from splatgraft.relighting.shading.normals import Normals, estimate_normals, raised
from splatgraft.relighting.shadows.light_sampling import main_count, sample_light
from splatgraft.relighting.shadows.receivers import RIM
from splatgraft.relighting.shadows.scene_ratio import (
    AMBIENT_SIZE,
    SceneShadowMaps,
    reachable,
    scene_shadow_maps,
    scene_visibility,
)
from splatgraft.relighting.shadows.shadow_maps import thinned
from splatgraft.runtime.memo import Memo


@dataclass(frozen=True)
class PreparedScene:
    """A part of a scene that waits for objects."""

    scene: Gaussians
    """All of it, erased Gaussians left out."""
    members: Int[Tensor, "m"]
    """Positions of the scene's Gaussians that objects may reach."""
    around: Gaussians
    """The members."""
    normals: Normals
    """Of the members."""
    light: Light
    """At the place."""
    maps: SceneShadowMaps
    """The scene's own depth maps for the bundles of `light`."""
    arrives: Float[Tensor, "m k"]
    """Share of every bundle that reaches the members past the scene."""


def prepare_scene(
    scene: Gaussians,
    cameras: Cameras,
    *,
    balls: Sequence[BoundingSphere],
    reach: float,
    light: Light | None,
    cache: Memo,
) -> tuple[PreparedScene | None, str | None]:
    """The stage for objects in `balls`, `reach` of their radii wide, or a sentence that says why there is none.

    `light` is estimated where none is given.
    """
    place = BoundingSphere(torch.stack([ball.center for ball in balls]).mean(0), max(ball.radius for ball in balls))
    region = _region(scene, place, reach, cache)
    if light is None:
        light, problem = _estimated(scene, cameras, place, region, cache)
        if light is None:
            return None, problem
    lit = light
    members = _members(scene, region, balls, lit, cache)
    around = cache.get("around", (members,), lambda: scene.select(members))
    # what hides them need not be finer than the maps are
    hiding = cache.get("hiding", (scene, region), lambda: thinned(scene, width=2 * region.radius / AMBIENT_SIZE))
    normals = cache.get("normals", (around, cameras), lambda: estimate_normals(around, cameras, among=hiding))
    maps = cache.get("maps", (scene, region, lit.sources), lambda: scene_shadow_maps(scene, region, sample_light(lit)))
    points = cache.get("points", (normals,), lambda: raised(around, normals.vectors))
    arrives = cache.get(
        "arrives",
        (maps, normals),
        lambda: _as_it_looks(around, normals, lit, scene_visibility(maps, points, normals.vectors)),
    )
    found = PreparedScene(
        scene=scene, members=members, around=around, normals=normals, light=lit, maps=maps, arrives=arrives
    )
    return found, None


def _region(scene: Gaussians, place: BoundingSphere, reach: float, cache: Memo) -> BoundingSphere:
    kept = cache.peek("region", (scene,))
    wanted = place.radius * reach
    if kept is not None and 0.8 * wanted <= kept.radius <= 2 * wanted:
        moved = float((kept.center - place.center).norm())
        if moved < 0.5 * kept.radius:
            return kept
    region = BoundingSphere(place.center, 1.2 * wanted)
    cache.put("region", (scene,), region)
    return region


def _members(
    scene: Gaussians, region: BoundingSphere, balls: Sequence[BoundingSphere], light: Light, cache: Memo
) -> Int[Tensor, "m"]:
    """What the objects may reach from where they are, and from a radius around."""
    kept = cache.peek("members", (scene, region, light.sources))
    if kept is not None:
        members, before = kept
        moves = [float((new.center - old.center).norm()) for new, old in zip(balls, before, strict=False)]
        if len(before) == len(balls) and all(m <= b.radius for m, b in zip(moves, balls, strict=True)):
            return members
    beams = sample_light(light)
    reached = torch.zeros(scene.count, dtype=torch.bool)
    rims = RIM * scene.scales.max(1).values
    for ball in balls:
        wide = rims + ball.radius
        reached |= reachable(scene.means, ball, beams, farthest=region.radius, rims=wide)
    members = (reached & ((scene.means - region.center).norm(dim=1) < region.radius)).nonzero()[:, 0]
    cache.put("members", (scene, region, light.sources), (members, tuple(balls)))
    return members


def _estimated(
    scene: Gaussians, cameras: Cameras, place: BoundingSphere, region: BoundingSphere, cache: Memo
) -> tuple[Light | None, str | None]:
    """The light at `place`; after a move within the region its sources are kept and the rest is looked at again."""
    kept = cache.peek("light", (scene, region))
    if kept is None:
        lights, problem = estimate_lights(scene, place, cameras)
        if lights is None:
            return None, problem
        cache.put("light", (scene, region), lights)
        return lights[1], None
    panorama, problem = panorama_at(scene, place)
    if panorama is None:
        return None, problem
    # sources keep their brightness too: depth maps and the object's own light are kept with them
    before, level = kept
    factor = float(level.ambient[0].sum() / before.ambient[0].sum().clamp_min(1e-9))
    here = light_from_panorama(panorama, estimate_up(cameras))
    return replace(here, sources=level.sources, ambient=factor * here.ambient), None


def _as_it_looks(
    gaussians: Gaussians, normals: Normals, light: Light, arrives: Float[Tensor, "m k"]
) -> Float[Tensor, "m k"]:
    """`arrives` with the main source taken from where the scene is plainly darker than it would make it."""
    if not light.sources:
        return arrives
    everything, count = sample_light(light), main_count(light)
    of_main = torch.arange(len(everything)) < count
    ours = replace(everything, irradiance=everything.irradiance * of_main[:, None])
    by_main = irradiance(ours, normals.vectors, arrives=arrives).mean(1)
    by_all = irradiance(everything, normals.vectors, arrives=arrives).mean(1)
    share = observed_sun_visibility(gaussians, normals, rest=by_all - by_main, light=by_main)
    return torch.cat([arrives[:, :count] * share[:, None], arrives[:, count:]], 1)
