"""The light at the objects' place in a scene, and the Gaussians there that may receive their shadows.

Shadow maps and sources are valid while the objects move by less than half of the maps' radius (`SceneLight.moved`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from splatgraft.core.bounds import BoundingSphere
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light, with_blocker_distances
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.samples import LightSamples, sample_light
from splatgraft.relighting.light.sun import Point
from splatgraft.relighting.shadows.receivers import RIM, Receivers, layer_height, layer_middle
from splatgraft.relighting.shadows.scene_ratio import SceneShadowMaps, reachable, scene_shadow_maps, scene_visibility

# the region of the shadow maps; set by hand
_MARGIN = 1.2  # radius of a new region over the required one
_KEPT_RADII = (0.8, 2.0)  # minimum and maximum radius of a region that is kept, over the required one
_KEPT_SHIFT = 0.5  # maximum distance of the objects' place from the centre of a kept region, in its radii


@dataclass(frozen=True)
class SceneLight:
    """The light of a scene at the place of objects, and the m receivers of their shadows."""

    captured: CapturedScene
    """Scene without erased Gaussians."""
    light: Light
    """Light at the objects' place."""
    estimate: EstimatedLight | None
    """Estimate that `light` comes from; None if the light was given."""
    samples: LightSamples
    """k samples of `light`."""
    maps: SceneShadowMaps
    """The scene's own shadow maps for the samples."""
    receivers: Receivers
    """Gaussians that the objects' shadows may reach, even after a move by up to an object's radius."""
    receivers_of: tuple[BoundingSphere, ...]
    """Bounding spheres of the objects for which the receivers were chosen."""
    reach: float
    """Maximum length of shadows except umbras, object radii."""

    def moved(self, spheres: Sequence[BoundingSphere]) -> "SceneLight | NoLight | None":
        """Move the objects: keep sources and shadow maps, and compute the ambient light at the new place.

        Args:
            spheres: The objects' new bounding spheres.

        Returns:
            None if the objects are too far from the maps' middle, need larger or much smaller maps, or moved between
            the sun and a shade.
        """
        place, region = place_of(spheres), self.maps.region
        least, most = (factor * place.radius * self.reach for factor in _KEPT_RADII)
        shift = float((region.center - place.center).norm())
        if not least <= region.radius <= most or shift >= _KEPT_SHIFT * region.radius:
            return None
        estimate, light = None, self.light
        if self.estimate is not None:
            estimate = self.estimate.at(self.captured, place)
            if isinstance(estimate, NoLight):
                return estimate
            if estimate.is_shaded != self.estimate.is_shaded:
                return None  # the maps belong to the same sources
            light = estimate.light
        there = replace(self, light=light, estimate=estimate, samples=sample_light(light))
        if len(spheres) == len(self.receivers_of) and all(
            float((new.center - old.center).norm()) <= new.radius
            for new, old in zip(spheres, self.receivers_of, strict=True)
        ):
            return there
        receivers = _receivers(self.captured, spheres, light, self.maps)
        return replace(there, receivers=receivers, receivers_of=tuple(spheres))


def find_scene_light(
    captured: CapturedScene,
    spheres: Sequence[BoundingSphere],
    *,
    light: Light | None,
    reach: float,
    sun_through: Sequence[Point] = (),
) -> SceneLight | NoLight:
    """Find the light of a scene at the place of objects.

    Args:
        captured: The scene without erased Gaussians.
        spheres: Bounding spheres of the objects, at least one.
        light: A given light, with sources as seen from the objects' place; None to estimate it.
        reach: Maximum length of shadows except umbras, object radii.
        sun_through: Points and their shadows, as for `light.sun.set_sun`, from which an estimate takes its sun.

    Returns:
        The light, or the reason why there is none.
    """
    place, scene = place_of(spheres), captured.gaussians
    estimate = None
    if light is None:
        found = estimate_light(captured, place, sun_through=sun_through)
        if isinstance(found, NoLight):
            return found
        estimate, light = found, found.light
    else:
        light = with_blocker_distances(light, scene, place)
    samples = sample_light(light)
    region = BoundingSphere(place.center, _MARGIN * (place.radius * reach))
    maps = scene_shadow_maps(scene, region, samples, radius=place.radius)
    receivers = _receivers(captured, spheres, light, maps)
    return SceneLight(captured, light, estimate, samples, maps, receivers, tuple(spheres), reach)


def place_of(spheres: Sequence[BoundingSphere]) -> BoundingSphere:
    """Return the mean centre of bounding spheres with the radius of the largest."""
    center = torch.stack([sphere.center for sphere in spheres]).mean(0)
    return BoundingSphere(center, max(sphere.radius for sphere in spheres))


def _receivers(
    captured: CapturedScene, spheres: Sequence[BoundingSphere], light: Light, maps: SceneShadowMaps
) -> Receivers:
    """Select the Gaussians that the objects' shadows may reach, even after a move by up to an object's radius."""
    scene, region, samples = captured.gaussians, maps.region, sample_light(light)
    reached = torch.zeros(scene.count, dtype=torch.bool)
    rims = RIM * scene.scales.max(1).values
    for sphere in spheres:
        reached |= reachable(scene.means, sphere, samples, farthest=region.radius, rims=rims + sphere.radius)
    indices = (reached & maps.covers(scene.means)).nonzero()[:, 0]
    gaussians = scene.with_sh_degree(0).select(indices)
    normals = captured.normals.vectors[indices]
    return Receivers(
        gaussians=gaussians,
        normals=normals,
        sample_visibility=scene_visibility(maps, gaussians.means, normals, heights=layer_height(gaussians, normals)),
        surface=layer_middle(gaussians, normals),
        origin=indices,
    )
