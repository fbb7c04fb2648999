"""The light at the objects' place in a scene, and the Gaussians there that may receive their shadows.

Shadow maps and sources are valid while the objects move by less than half of the maps' radius (`SceneLight.moved`).

Uncaptured things may block the scene's main light: sunlight through a window lights a patch of a table, but the
window's frame is missing from the shadow maps. The table's colours show the patch. So the visibility of the main light
is also measured from brightness, which is compared within groups of one material and smoothed over neighbours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light, with_blocker_distances
from splatgraft.relighting.light.evidence import group_materials
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.samples import LightSamples, main_source_samples, sample_light
from splatgraft.relighting.light.sun import Point
from splatgraft.relighting.nearest_neighbours import nearest_neighbours
from splatgraft.relighting.normals import Normals
from splatgraft.relighting.shading import irradiance
from splatgraft.relighting.shadows.receivers import RIM, Receivers, above_layer, layer_middle
from splatgraft.relighting.shadows.scene_ratio import SceneShadowMaps, reachable, scene_shadow_maps, scene_visibility

# the region of the shadow maps; set by hand
_MARGIN = 1.2  # radius of a new region over the required one
_KEPT_RADII = (0.8, 2.0)  # minimum and maximum radius of a region that is kept, over the required one
_KEPT_SHIFT = 0.5  # maximum distance of the objects' place from the centre of a kept region, in its radii

# visibility of the main light from brightness; set by hand
_SMOOTHED = 64  # gaussians in the median
_CONTRAST = 0.5  # minimum irradiance of the main light over that of the rest; with less, brightness does not show it
_MIN_GAUSSIANS = 500  # with fewer the visibility is not measured
_LIT_QUANTILE = 0.75  # quantile of apparent albedo in a group that counts as the albedo of fully lit Gaussians
_RAMP_START, _RAMP_WIDTH = 0.2, 0.4  # ramp from 0 to 1 over the measured visibility: faint light counts as none


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
    """Maximum length of shadows, object radii."""

    def moved(self, spheres: Sequence[BoundingSphere]) -> "SceneLight | NoLight | None":
        """Move the objects: keep sources and shadow maps, and compute the ambient light at the new place.

        Args:
            spheres: The objects' new bounding spheres.

        Returns:
            None if the objects are too far from the maps' middle, or need larger or much smaller maps.
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
        reach: Maximum length of shadows, object radii.
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
    maps = scene_shadow_maps(scene, BoundingSphere(place.center, _MARGIN * (place.radius * reach)), samples)
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
    indices = (reached & ((scene.means - region.center).norm(dim=1) < region.radius)).nonzero()[:, 0]
    gaussians = scene.select(indices)
    normals = captured.normals.select(indices)
    shares = scene_visibility(maps, above_layer(gaussians, normals.vectors), normals.vectors)
    return Receivers(
        gaussians=gaussians,
        normals=normals.vectors,
        sample_visibility=_with_observed_light(gaussians, normals, light, shares),
        surface=layer_middle(gaussians, normals.vectors),
        origin=indices,
    )


def _with_observed_light(
    gaussians: Gaussians, normals: Normals, light: Light, sample_visibility: Float[Tensor, "m k"]
) -> Float[Tensor, "m k"]:
    """Reduce the visibility of the main source for Gaussians whose colours show that it does not arrive."""
    if not light.sources:
        return sample_visibility
    samples, count = sample_light(light), main_source_samples(light)
    is_main = torch.arange(len(samples)) < count
    main = replace(samples, irradiance=samples.irradiance * is_main[:, None])
    by_main = irradiance(main, normals.vectors, sample_visibility=sample_visibility).mean(1)
    by_all = irradiance(samples, normals.vectors, sample_visibility=sample_visibility).mean(1)
    share = _observed_visibility(gaussians, normals, rest=by_all - by_main, main=by_main)
    return torch.cat([sample_visibility[:, :count] * share[:, None], sample_visibility[:, count:]], 1)


def _observed_visibility(
    gaussians: Gaussians, normals: Normals, *, rest: Float[Tensor, "m"], main: Float[Tensor, "m"]
) -> Float[Tensor, "m"]:
    """Measure the visibility of the main light from the colours of m Gaussians, in [0, 1]; 1 if unknown.

    `main` is the gray irradiance of the main light by shadow maps, `rest` that of all other light.
    """
    share = torch.ones(gaussians.count)
    brightness = linear_from_srgb(rgb_from_dc(gaussians.sh[:, 0]).clamp(0.01, 1))  # darker channels are noise
    usable = (main > _CONTRAST * rest) & normals.seen & (gaussians.opacities > 0.1)
    index = usable.nonzero()[:, 0]
    if len(index) < _MIN_GAUSSIANS:
        return share
    groups = group_materials(brightness[index], normals.vectors[index])
    value = brightness[index].mean(1)
    full, without = (rest + main)[index], rest[index]
    albedo = value / full
    # a group without any lit Gaussian is no evidence and thus gets visibility 1
    lit_albedo = torch.zeros(int(groups.max()) + 1)
    for group in range(len(lit_albedo)):
        inside = groups == group
        if bool(inside.any()):
            lit_albedo[group] = albedo[inside].quantile(_LIT_QUANTILE)
    measured = ((value / lit_albedo[groups].clamp_min(1e-6) - without) / (full - without)).clamp(0, 1)
    neighbours = nearest_neighbours(gaussians.means[index], count=_SMOOTHED)
    smooth = measured[neighbours.long()].median(1).values
    share[index] = ((smooth - _RAMP_START) / _RAMP_WIDTH).clamp(0, 1)
    return share
