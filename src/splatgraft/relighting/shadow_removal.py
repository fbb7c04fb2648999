"""Removal of an object's shadow and bounce from the capture that the object was taken from."""

from dataclasses import dataclass, replace

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import NoLight, estimate_light
from splatgraft.relighting.prepared_object import SourceScene
from splatgraft.relighting.shading.gain import apply_gain
from splatgraft.relighting.shading.normals import estimate_normals, raised
from splatgraft.relighting.shadows.light_sampling import sample_light
from splatgraft.relighting.shadows.scene_ratio import (
    object_shadow_maps,
    reachable,
    scene_ratio,
    scene_shadow_maps,
    scene_visibility,
)


@dataclass(frozen=True)
class ShadowRemovalSettings:
    """Extent and strength of the removal, both set by hand."""

    brightest: float = 4.0
    """Most gain; what was darker than a quarter is mostly noise and stays dark."""
    reach: float = 8.0
    """Object radii to which shadows are removed."""


def remove_object_shadow(
    source: SourceScene,
    object_gaussians: Gaussians,
    *,
    settings: ShadowRemovalSettings = ShadowRemovalSettings(),
) -> tuple[Gaussians, tuple[str, ...]]:
    """Divide the colours around an object's old place by the ratio of its shadow and bounce.

    Args:
        source: The capture without the object; its light is estimated where it is not told.
        object_gaussians: The object, in the same frame.
        settings: Extent and strength.

    Returns:
        The scene, Gaussian for Gaussian, and sentences for a report. The scene is unchanged where the light cannot be
        estimated.
    """
    scene, sphere = source.gaussians, bounding_sphere(object_gaussians)
    light = source.light or estimate_light(scene, sphere, source.cameras, object_gaussians=object_gaussians)
    if isinstance(light, NoLight):
        return scene, (f"{light.reason} The old place stays as it is.",)
    samples = sample_light(light)
    region = BoundingSphere(sphere.center, settings.reach * sphere.radius)
    index = reachable(scene.means, sphere, samples, farthest=region.radius).nonzero()[:, 0]
    if len(index) == 0:
        return scene, ("Nothing stands within the reach of the object's shadow.",)
    receivers = scene.select(index)
    normals = estimate_normals(receivers, source.cameras).vectors
    scene_maps = scene_shadow_maps(scene, region, samples)
    shares = scene_visibility(scene_maps, raised(receivers, normals), normals)
    maps = object_shadow_maps(object_gaussians, sphere, samples)
    ratio = scene_ratio(maps, receivers.means, normals, sample_visibility=shares)
    gain = 1 / (ratio.shadow + ratio.bounce).clamp(1 / settings.brightest, settings.brightest)
    sh = scene.sh.clone()
    sh[index] = apply_gain(receivers, gain).sh
    return replace(scene, sh=sh), (light.describe(estimate_up(source.cameras)) + ".",)
