"""Measure the true light at a point inside Blender: a panorama of its environment, and the suns."""

import math

import bpy
import numpy as np
import passes
import scene_builder
from mathutils import Vector

WIDTH, HEIGHT = 128, 64
_DISC_MARGIN = 2.5 * math.pi / HEIGHT  # radians; the pixel filter spreads the sun's disc by 2.5 pixels
_SUN_PIXELS = 24  # width and height of the image that measures the sky's sun


def measure(scene, world, point, things):
    """Render the radiance (64, 128, 3) around `point` without the suns' discs, and list the suns that reach it.

    Units are Blender's. Surfaces in the panorama are lit by the suns. Row 0 looks up, the middle column along +x;
    columns run to the right as seen from inside (towards -y).
    """
    cycles, layer = bpy.context.scene.cycles, bpy.context.scene
    lamps = [thing for thing in things if thing.type == "LIGHT"]
    # a visible sun would be counted twice, in the panorama and in the list
    shown = [thing for thing in lamps if thing.data.type != "SUN"]
    for thing in shown:
        thing.visible_camera = True
    layer.render.resolution_x, layer.render.resolution_y = WIDTH, HEIGHT
    layer.render.film_transparent = False  # otherwise the world is not rendered
    cycles.samples = 64
    camera = _panoramic(point)
    panorama = _panorama(camera, {**world, "sun_disc": False})
    if world["kind"] == "sky":
        # the panorama contains surfaces lit by the sun, but not the sun's disc
        cycles.use_denoising = False  # the denoiser would spread the disc over its neighbours
        with_sun = _panorama(camera, {**world, "sun_disc": True})
        cycles.use_denoising = True
        disc = _around(_towards_sun(world), 0.5 * world["sun_size"] + _DISC_MARGIN)
        panorama = np.where(disc[..., None], panorama, with_sun)
    for thing in shown:
        thing.visible_camera = False
    suns = [_lamp_sun(lamp) for lamp in scene["lamps"] if lamp["kind"] == "sun"]
    if world["kind"] == "sky":
        suns.append(_sky_sun(world, things))
    return panorama, [sun for sun in suns if _reaches(point, sun["direction"])]


def _panorama(camera, world):
    bpy.context.scene.world = scene_builder.make_world(world)
    return passes.render(camera, ["color"])["color"][..., :3].astype(np.float64)


def _around(towards, angle):
    """Mask the panorama's pixels (64, 128) within `angle`, radians, of a unit direction."""
    height = math.pi * (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None]
    turn = -2 * math.pi * ((np.arange(WIDTH) + 0.5) / WIDTH - 0.5)[None]
    x, y, z = np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height) + 0 * turn
    return x * towards[0] + y * towards[1] + z * towards[2] > math.cos(angle)


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
    return {
        "direction": list(towards),
        "irradiance": irradiance,
        "angular_radius": 0.5 * lamp["size"],
    }


def _towards_sun(world):
    flat, turn = math.cos(world["sun_elevation"]), world["sun_azimuth"]
    return Vector((flat * math.cos(turn), flat * math.sin(turn), math.sin(world["sun_elevation"])))


def _sky_sun(world, things):
    """Measure the sun of the Nishita sky, as the difference of narrow renders with and without the sun's disc."""
    towards = _towards_sun(world)
    angle = 2.0 * world["sun_size"]
    camera = scene_builder.add_camera(
        {"location": (0, 0, 0), "target": tuple(towards), "field_of_view": angle}, "towards the sun"
    )
    hidden = [thing.hide_render for thing in things]
    for thing in things:
        thing.hide_render = True
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = _SUN_PIXELS
    scene.cycles.use_denoising = False
    images = []
    for disc in (True, False):
        scene.world = scene_builder.make_world({**world, "sun_disc": disc})
        images.append(passes.render(camera, ["color"])["color"][..., :3].astype(np.float64))
    scene.cycles.use_denoising = True
    for thing, value in zip(things, hidden, strict=True):
        thing.hide_render = value
    solid_angle = (2 * math.tan(angle / 2) / _SUN_PIXELS) ** 2
    irradiance = np.maximum(images[0] - images[1], 0).sum((0, 1)) * solid_angle
    return {
        "direction": list(towards),
        "irradiance": irradiance.tolist(),
        "angular_radius": 0.5 * world["sun_size"],
    }


def _reaches(point, direction):
    """Return whether no rendered mesh blocks the sun; inserted objects are hidden while the light is measured."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    start, towards = Vector(point), Vector(direction).normalized()
    while True:
        hit, where, _, _, thing, _ = bpy.context.scene.ray_cast(depsgraph, start, towards)
        if not hit:
            return True
        if not thing.hide_render:
            return False
        start = where + 1e-4 * towards
