"""Takes an object's shadow out of the capture that it was taken from. Knows nothing about where the object goes."""

from dataclasses import replace

from splatgraft.gaussians import Gaussians
from splatgraft.orbit import estimate_up
from splatgraft.relight.beams import beams_of
from splatgraft.relight.body import SourceScene
from splatgraft.relight.local_gain import apply_gain
from splatgraft.relight.normals import estimate_normals, raised
from splatgraft.relight.place_light import light_at
from splatgraft.relight.scene_shading import (
    Ball,
    ball_of,
    map_object,
    map_scene,
    reachable,
    scene_ratio,
    scene_visibility,
)

_BRIGHTEST = 4.0  # what was darker than a quarter is noise, and stays dark
_REACH = 8.0  # object radii


def without_shadow(source: SourceScene, own: Gaussians) -> tuple[Gaussians, tuple[str, ...]]:
    """The scene around an object as if the object `own` had never stood there: colours over the shadow's ratio.

    Gaussian for Gaussian, with sentences on what was found; unchanged where the light cannot be told.
    """
    scene, ball = source.gaussians, ball_of(own)
    light, problem = light_at(scene, ball, source.cameras, also=own)
    if light is None:
        return scene, (f"{problem} The old place stays as it is.",)
    beams = beams_of(light)
    region = Ball(ball.center, _REACH * ball.radius)
    index = reachable(scene.means, ball, beams, farthest=region.radius).nonzero()[:, 0]
    if len(index) == 0:
        return scene, ("Nothing stands within the reach of the object's shadow.",)
    receivers = scene.select(index)
    facing = estimate_normals(receivers, source.cameras).vectors
    arrives = scene_visibility(map_scene(scene, region, beams), raised(receivers, facing), facing)
    ratio = scene_ratio(map_object(own, ball, beams), receivers.means, facing, arrives=arrives)
    gain = 1 / (ratio.shadow + ratio.bounce).clamp(1 / _BRIGHTEST, _BRIGHTEST)
    sh = scene.sh.clone()
    sh[index] = apply_gain(receivers, gain).sh
    return replace(scene, sh=sh), (light.describe(estimate_up(source.cameras)) + ".",)
