"""Panoramas and photos of a known garden and a known room, for `panoramas.py`; runs in Blender's Python.

python panorama_scenes.py garden|room FOLDER
"""

import json
import math
import random
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

PANORAMAS, PHOTOS = 8, 16
PANORAMA_WIDTH, PHOTO_WIDTH, SAMPLES = 1024, 400, 4
SUN = Vector((0.55, -0.35, 0.76)).normalized()
LAMP = Vector((1.6, 1.2, 2.3))
EYE_HEIGHT = 1.6  # metres


def material(name, first, second, scale):
    """Return a matt material of two colours in blotches, so that features can be found on it."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    noise, ramp, place = (nodes.new(f"ShaderNode{kind}") for kind in ("TexNoise", "ValToRGB", "TexCoord"))
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = scale, 3.0
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.42, 0.58
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (*first, 1), (*second, 1)
    links.new(place.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = 0.9
    links.new(ramp.outputs["Color"], surface.inputs["Base Color"])
    return made


def box(center, size, made, turn=0.0):
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=center, rotation=(0, 0, turn))
    thing = bpy.context.object
    thing.scale = size
    thing.data.materials.append(made)


def furnish(reach):
    """Stand boxes of several colours in a ring around the middle."""
    generator = random.Random(3)
    for i in range(9):
        angle, away = 2 * math.pi * i / 9 + generator.uniform(-0.2, 0.2), generator.uniform(0.75, 1.0) * reach
        high, color = generator.uniform(0.5, 1.6), [generator.uniform(0.1, 0.7) for _ in range(3)]
        made = material(f"box {i}", color, [0.3 * c for c in color], 3.0)
        box((away * math.cos(angle), away * math.sin(angle), high / 2), (0.6, 0.5, high), made, angle)
    box((0.1, 0.0, 0.25), (0.5, 0.4, 0.5), material("middle", (0.6, 0.5, 0.2), (0.2, 0.1, 0.05), 4.0), 0.4)


def garden():
    """A lawn with boxes under a sun and an even blue sky."""
    box((0, 0, -0.05), (60, 60, 0.1), material("lawn", (0.18, 0.3, 0.08), (0.07, 0.12, 0.03), 60.0))
    furnish(5.0)
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world, world.use_nodes = world, True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.35, 0.5, 0.8, 1)
    light = bpy.data.lights.new("sun", "SUN")
    light.energy, light.angle = 3.0, math.radians(0.5)
    thing = bpy.data.objects.new("sun", light)
    thing.rotation_euler = SUN.to_track_quat("Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(thing)
    return {"sun": list(SUN)}


def room():
    """A closed room of 7 by 6 by 2.8 metres with one lamp."""
    plaster = material("plaster", (0.7, 0.65, 0.55), (0.45, 0.4, 0.35), 2.5)
    wood = material("wood", (0.4, 0.25, 0.12), (0.2, 0.1, 0.05), 8.0)
    for center, size, made in (
        ((0, 0, -0.05), (7, 6, 0.1), wood),
        ((0, 0, 2.85), (7, 6, 0.1), plaster),
        ((3.55, 0, 1.4), (0.1, 6, 2.8), plaster),
        ((-3.55, 0, 1.4), (0.1, 6, 2.8), plaster),
        ((0, 3.05, 1.4), (7, 0.1, 2.8), plaster),
        ((0, -3.05, 1.4), (7, 0.1, 2.8), plaster),
    ):
        box(center, size, made)
    furnish(2.6)
    bpy.context.scene.world = bpy.data.worlds.new("black")
    light = bpy.data.lights.new("lamp", "POINT")
    light.energy, light.shadow_soft_size = 250.0, 0.12
    thing = bpy.data.objects.new("lamp", light)
    thing.location = LAMP
    bpy.context.scene.collection.objects.link(thing)
    return {"lamp": list(LAMP)}


def shoot(file, matrix, width, height, *, panorama):
    scene = bpy.context.scene
    camera = bpy.data.cameras.new("camera")
    if panorama:
        camera.type, camera.panorama_type = "PANO", "EQUIRECTANGULAR"
    else:
        camera.angle = math.radians(60)
    thing = bpy.data.objects.new("camera", camera)
    thing.matrix_world = matrix
    scene.collection.objects.link(thing)
    scene.camera, scene.render.filepath = thing, str(file)
    scene.render.resolution_x, scene.render.resolution_y = width, height
    bpy.ops.render.render(write_still=True)


def main(kind, folder):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    truth = {"garden": garden, "room": room}[kind]()
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", SAMPLES
    scene.cycles.use_denoising, scene.cycles.max_bounces = False, 2
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.view_settings.view_transform, scene.view_settings.exposure = "Standard", -0.6
    poses = []
    for i in range(PANORAMAS):
        angle = 2 * math.pi * i / PANORAMAS
        place = Vector((1.7 * math.cos(angle), 1.4 * math.sin(angle), EYE_HEIGHT + 0.15 * math.sin(3 * i)))
        # upright, turned about z
        matrix = Matrix.Translation(place) @ Matrix.Rotation(0.9 * i, 4, "Z") @ Matrix.Rotation(math.pi / 2, 4, "X")
        file = folder / "panoramas" / f"{i:02d}.png"
        shoot(file, matrix, PANORAMA_WIDTH, PANORAMA_WIDTH // 2, panorama=True)
        poses.append([list(row) for row in matrix])
    frames = []
    for i in range(PHOTOS):
        angle = 2 * math.pi * i / PHOTOS
        eye = Vector((2.0 * math.cos(angle), 2.0 * math.sin(angle), 1.1 if i % 2 else 1.6))
        turn = (eye - Vector((0, 0, 0.2))).to_track_quat("Z", "Y").to_matrix().to_4x4()
        matrix = Matrix.Translation(eye) @ turn
        shoot(folder / "images" / f"{i:02d}.png", matrix, PHOTO_WIDTH, PHOTO_WIDTH * 3 // 4, panorama=False)
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": [list(row) for row in matrix]})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": math.radians(60), "frames": frames}))
    (folder / "truth.json").write_text(json.dumps(truth | {"panoramas": poses}))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
