"""The true light at a point: a panorama of what shines there, and the suns. Runs inside Blender; knows no objects."""

import math

import bpy
import contents
import numpy as np
import passes
from mathutils import Vector

WIDTH, HEIGHT = 128, 64
_SAMPLES = 64
_SUN_PIXELS = 24


def measure(scene, world, point, things):
    """Radiance (64, 128, 3) around `point` without suns, and the suns that reach it; Blender's units.

    Row 0 looks up, the middle column along +x, columns run to the right seen from inside (towards -y).
    """
    cycles, layer = bpy.context.scene.cycles, bpy.context.scene
    shown = [thing for thing in things if thing.type == "LIGHT"]
    for thing in shown:
        thing.visible_camera = True
    layer.world = contents.make_world({**world, "sun_disc": False})
    layer.render.resolution_x, layer.render.resolution_y = WIDTH, HEIGHT
    layer.render.film_transparent = False  # or the world would be left out
    cycles.samples = _SAMPLES
    panorama = passes.render(_panoramic(point), ["color"])["color"][..., :3].astype(np.float64)
    for thing in shown:
        thing.visible_camera = False
    suns = [_lamp_sun(lamp) for lamp in scene["lamps"] if lamp["kind"] == "sun"]
    if world["kind"] == "sky":
        suns.append(_sky_sun(world, things))
    return panorama, [sun for sun in suns if _reaches(point, sun["direction"])]


def _panoramic(point):
    data = bpy.data.cameras.new("probe")
    data.type, data.clip_start = "PANO", 0.001
    data.panorama_type = "EQUIRECTANGULAR"
    thing = bpy.data.objects.new("probe", data)
    thing.location = point
    thing.rotation_euler = (math.pi / 2, 0, -math.pi / 2)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def _lamp_sun(lamp):
    towards = -Vector(lamp["direction"]).normalized()
    irradiance = [lamp["power"] * channel for channel in lamp["color"]]
    return {"direction": list(towards), "irradiance": irradiance, "angular_radius": 0.5 * lamp["size"]}


def _sky_sun(world, things):
    """The disc of the Nishita sky, measured through a narrow camera with the disc and without it."""
    flat = math.cos(world["sun_elevation"])
    towards = Vector(
        (flat * math.cos(world["sun_azimuth"]), flat * math.sin(world["sun_azimuth"]), math.sin(world["sun_elevation"]))
    )
    angle = 2.0 * world["sun_size"]
    camera = contents.add_camera(
        {"location": (0, 0, 0), "target": tuple(towards), "field_of_view": angle}, "towards the sun"
    )
    hidden = [thing.hide_render for thing in things]
    for thing in things:
        thing.hide_render = True
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = _SUN_PIXELS
    scene.cycles.use_denoising = False
    seen = []
    for disc in (True, False):
        scene.world = contents.make_world({**world, "sun_disc": disc})
        seen.append(passes.render(camera, ["color"])["color"][..., :3].astype(np.float64))
    scene.cycles.use_denoising = True
    for thing, value in zip(things, hidden, strict=True):
        thing.hide_render = value
    solid_angle = (2 * math.tan(angle / 2) / _SUN_PIXELS) ** 2
    irradiance = np.maximum(seen[0] - seen[1], 0).sum((0, 1)) * solid_angle
    return {"direction": list(towards), "irradiance": irradiance.tolist(), "angular_radius": 0.5 * world["sun_size"]}


def _reaches(point, direction):
    """Whether nothing that is rendered stands between the point and the sun; the object around the point is not."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    start, towards = Vector(point), Vector(direction).normalized()
    while True:
        hit, where, _, _, thing, _ = bpy.context.scene.ray_cast(depsgraph, start, towards)
        if not hit:
            return True
        if not thing.hide_render:
            return False
        start = where + 1e-4 * towards
