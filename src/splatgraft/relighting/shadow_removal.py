"""Takes an object's shadow out of the capture that it was taken from. Knows nothing about where the object goes."""

from dataclasses import replace

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import estimate_light
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

_BRIGHTEST = 4.0  # what was darker than a quarter is noise, and stays dark
_REACH = 8.0  # object radii


def remove_object_shadow(source: SourceScene, own: Gaussians) -> tuple[Gaussians, tuple[str, ...]]:
    """The scene around an object as if the object `own` had never stood there: colours over the shadow's ratio.

    Gaussian for Gaussian, with sentences on what was found; unchanged where the light cannot be told.
    """
    scene, ball = source.gaussians, bounding_sphere(own)
    light, problem = estimate_light(scene, ball, source.cameras, also=own)
    if light is None:
        return scene, (f"{problem} The old place stays as it is.",)
    beams = sample_light(light)
    region = BoundingSphere(ball.center, _REACH * ball.radius)
    index = reachable(scene.means, ball, beams, farthest=region.radius).nonzero()[:, 0]
    if len(index) == 0:
        return scene, ("Nothing stands within the reach of the object's shadow.",)
    receivers = scene.select(index)
    facing = estimate_normals(receivers, source.cameras).vectors
    arrives = scene_visibility(scene_shadow_maps(scene, region, beams), raised(receivers, facing), facing)
    ratio = scene_ratio(object_shadow_maps(own, ball, beams), receivers.means, facing, arrives=arrives)
    gain = 1 / (ratio.shadow + ratio.bounce).clamp(1 / _BRIGHTEST, _BRIGHTEST)
    sh = scene.sh.clone()
    sh[index] = apply_gain(receivers, gain).sh
    return replace(scene, sh=sh), (light.describe(estimate_up(source.cameras)) + ".",)
