"""The scene around the place of objects, prepared for lighting: light, receivers, normals and shadow maps.

Cached results stay valid while the objects' place moves by less than half of the region's radius.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import EstimatedLight, NoLight, fit_light
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.source_distance import with_source_distances
from splatgraft.relighting.light.sun_visibility import observed_sun_visibility
from splatgraft.relighting.shading.irradiance import irradiance
from splatgraft.relighting.shading.normals import Normals, estimate_normals
from splatgraft.relighting.shadows.light_sampling import LightSamples, main_source_samples, sample_light
from splatgraft.relighting.shadows.receivers import RIM
from splatgraft.relighting.shadows.scene_ratio import (
    SceneShadowMaps,
    ShadowMapSettings,
    reachable,
    scene_shadow_maps,
    scene_visibility,
)
from splatgraft.relighting.shadows.shadow_maps import thinned
from splatgraft.relighting.shadows.surface_layer import above_layer, layer_middle
from splatgraft.runtime.memo import Memo

REGION = "region"
"""Name in a cache of the region around the objects; a cache that forgets it computes the scene and its light anew."""
# set by hand
_MARGIN = 1.2
"""Radius of a new region over what the objects need."""
_KEPT_RADII = (0.8, 2.0)
"""Least and most radius of a cached region over what the objects need."""
_KEPT_SHIFT = 0.5
"""Radii of a cached region by which the objects' place may be off its centre."""


@dataclass(frozen=True)
class PreparedScene:
    """A scene that objects are placed in, and the m receivers of their shadows."""

    scene: Gaussians
    """All Gaussians that are not erased."""
    receiver_indices: Int[Tensor, "m"]
    """Positions in `scene` of the Gaussians that objects may reach."""
    receivers: Gaussians
    """Those Gaussians."""
    normals: Normals
    """Of the receivers."""
    light: Light
    """At the objects' place."""
    estimate: EstimatedLight | None
    """What `light` rests on; None where it was told."""
    samples: LightSamples
    """k samples of `light`."""
    maps: SceneShadowMaps
    """The scene's own shadow maps for the samples."""
    surface: Float[Tensor, "m 3"]
    """For each receiver the nearest point of the surface that it is part of."""
    sample_visibility: Float[Tensor, "m k"]
    """Share of every sample that reaches the receivers past the scene, in [0, 1]."""


def prepare_scene(
    scene: Gaussians,
    cameras: Cameras,
    *,
    spheres: Sequence[BoundingSphere],
    reach: float,
    light: Light | None,
    cache: Memo,
) -> PreparedScene | NoLight:
    """Prepare a scene for objects.

    Args:
        scene: All Gaussians that are not erased.
        cameras: Of its capture.
        spheres: Of the objects, at least one.
        reach: Object radii to which shadows are computed.
        light: At the objects' place, its sources seen from there; None to estimate it.
        cache: Reused where the scene is the same and the place has moved little.
    """
    center = torch.stack([sphere.center for sphere in spheres]).mean(0)
    place = BoundingSphere(center, max(sphere.radius for sphere in spheres))
    region = _region(scene, place, reach, cache)
    if light is None:
        estimate = _estimated_light(scene, cameras, place, region, cache)
        if isinstance(estimate, NoLight):
            return estimate
        known = estimate.light
    else:
        estimate = None
        known = cache.get("told light", (scene, region, light), lambda: with_source_distances(light, scene, place))
    samples = sample_light(known)
    indices = _receiver_indices(scene, region, spheres, known, cache)
    receivers = cache.get("receivers", (indices,), lambda: scene.select(indices))
    # for the test of what cameras see, occluders need not be finer than a shadow map's pixel
    width = 2 * region.radius / ShadowMapSettings().ambient_size
    occluders = cache.get("occluders", (scene, region), lambda: thinned(scene, width=width))
    normals = cache.get("normals", (receivers, cameras), lambda: estimate_normals(receivers, cameras, among=occluders))
    maps = cache.get("maps", (scene, region, known.sources), lambda: scene_shadow_maps(scene, region, samples))
    points = cache.get("points", (normals,), lambda: above_layer(receivers, normals.vectors))
    sample_visibility = cache.get(
        "sample visibility",
        (maps, normals),
        lambda: _with_observed_sun(receivers, normals, known, scene_visibility(maps, points, normals.vectors)),
    )
    return PreparedScene(
        scene=scene,
        receiver_indices=indices,
        receivers=receivers,
        normals=normals,
        light=known,
        estimate=estimate,
        samples=samples,
        maps=maps,
        surface=cache.get("surface", (normals,), lambda: layer_middle(receivers, normals.vectors)),
        sample_visibility=sample_visibility,
    )


def _region(scene: Gaussians, place: BoundingSphere, reach: float, cache: Memo) -> BoundingSphere:
    """The sphere within which shadows are computed: the cached one where it fits."""
    cached = cache.peek(REGION, (scene,))
    wanted = place.radius * reach
    least, most = _KEPT_RADII
    if cached is not None and least * wanted <= cached.radius <= most * wanted:
        moved = float((cached.center - place.center).norm())
        if moved < _KEPT_SHIFT * cached.radius:
            return cached
    region = BoundingSphere(place.center, _MARGIN * wanted)
    cache.put(REGION, (scene,), region)
    return region


def _receiver_indices(
    scene: Gaussians, region: BoundingSphere, spheres: Sequence[BoundingSphere], light: Light, cache: Memo
) -> Int[Tensor, "m"]:
    """Gaussians that the objects may reach from where they are, and after a move by up to their radius."""
    cached = cache.peek("receiver indices", (scene, region, light.sources))
    if cached is not None:
        indices, earlier = cached
        moves = [float((new.center - old.center).norm()) for new, old in zip(spheres, earlier, strict=False)]
        if len(earlier) == len(spheres) and all(m <= s.radius for m, s in zip(moves, spheres, strict=True)):
            return indices
    samples = sample_light(light)
    reached = torch.zeros(scene.count, dtype=torch.bool)
    rims = RIM * scene.scales.max(1).values
    for sphere in spheres:
        reached |= reachable(scene.means, sphere, samples, farthest=region.radius, rims=rims + sphere.radius)
    indices = (reached & ((scene.means - region.center).norm(dim=1) < region.radius)).nonzero()[:, 0]
    cache.put("receiver indices", (scene, region, light.sources), (indices, tuple(spheres)))
    return indices


def _estimated_light(
    scene: Gaussians,
    cameras: Cameras,
    place: BoundingSphere,
    region: BoundingSphere,
    cache: Memo,
) -> EstimatedLight | NoLight:
    """The light at `place`; after a move within the region the sources are kept and the ambient light is new.

    Shadow maps and the object's own shading are cached with the sources.
    """
    cached: EstimatedLight | None = cache.peek("light", (scene, region))
    if cached is not None:
        return cached.at(scene, cameras, place)
    found = fit_light(scene, place, cameras)
    if not isinstance(found, NoLight):
        cache.put("light", (scene, region), found)
    return found


def _with_observed_sun(
    gaussians: Gaussians, normals: Normals, light: Light, sample_visibility: Float[Tensor, "m k"]
) -> Float[Tensor, "m k"]:
    """`sample_visibility` with the main source's reduced where the scene's colours show that it does not arrive."""
    if not light.sources:
        return sample_visibility
    samples, count = sample_light(light), main_source_samples(light)
    is_main = torch.arange(len(samples)) < count
    main = replace(samples, irradiance=samples.irradiance * is_main[:, None])
    by_main = irradiance(main, normals.vectors, sample_visibility=sample_visibility).mean(1)
    by_all = irradiance(samples, normals.vectors, sample_visibility=sample_visibility).mean(1)
    share = observed_sun_visibility(gaussians, normals, rest=by_all - by_main, light=by_main)
    return torch.cat([sample_visibility[:, :count] * share[:, None], sample_visibility[:, count:]], 1)
