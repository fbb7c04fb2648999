"""Write six kinds of textured meshes as .glb with Blender, and a picture of each: `python blender_meshes.py FOLDER`.

It runs in a Python with bpy. The picture (.png, from 1.5 radii) shows the base colour of the imported .glb under white
light, on black.

matte: a turned vase with vertex colours; glossy: a bumpy ball with a normal map; metal: a ring of rough metal; painted:
a can with a printed JPEG; thin: a bent sheet without thickness; concave: a bowl with a WebP texture. All
are one unit high and stand on z = 0.
"""

import math
import sys
from pathlib import Path

import bpy  # isort: skip; it brings bmesh
import bmesh
import numpy as np
from mathutils import Vector

SIZE = 256  # pixels of a texture


def image(name, pixels, *, is_data=False):
    made = bpy.data.images.new(name, SIZE, SIZE, is_data=is_data)
    rgba = np.concatenate([pixels, np.ones((SIZE, SIZE, 1))], 2)
    made.pixels.foreach_set(rgba[::-1].astype(np.float32).ravel())
    made.pack()
    return made


def material(name, color=(0.8, 0.8, 0.8), *, metallic=0.0, roughness=0.5, color_map=None, normal_map=None):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (*color, 1)
    surface.inputs["Metallic"].default_value, surface.inputs["Roughness"].default_value = metallic, roughness
    if color_map is not None:
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = color_map
        links.new(texture.outputs["Color"], surface.inputs["Base Color"])
    if normal_map is not None:
        texture, bent = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeNormalMap")
        texture.image = normal_map
        links.new(texture.outputs["Color"], bent.inputs["Color"])
        links.new(bent.outputs["Normal"], surface.inputs["Normal"])
    return made


def lathe(name, profile, *, steps=64):
    """Turn a profile of (radius, height) about z; u runs round, v along the profile."""
    built = bmesh.new()
    uv = built.loops.layers.uv.new()
    rows = [
        [built.verts.new((r * math.cos(a), r * math.sin(a), z)) for r, z in profile]
        for a in (2 * math.pi * i / steps for i in range(steps))
    ]
    last = len(profile) - 1
    for i, row in enumerate(rows):
        following = rows[(i + 1) % steps]
        for j in range(last):
            face = built.faces.new((row[j], following[j], following[j + 1], row[j + 1]))
            places = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            for loop, (u, v) in zip(face.loops, places, strict=True):
                loop[uv].uv = (u / steps, v / last)
            face.smooth = True
    bmesh.ops.remove_doubles(built, verts=built.verts, dist=1e-5)
    bmesh.ops.recalc_face_normals(built, faces=built.faces)
    return finish(name, built)


def finish(name, built):
    data = bpy.data.meshes.new(name)
    built.to_mesh(data)
    built.free()
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def arc(radius, height, count, start, end):
    angles = (start + (end - start) * i / (count - 1) for i in range(count))
    return [(radius * math.sin(a), height - radius * math.cos(a)) for a in angles]


def matte():
    waves = [(0.22 + 0.13 * math.sin(5 * z + 0.4), z) for z in (i / 24 for i in range(25))]
    thing = lathe("matte", [(0.0, 0.0), *waves, (0.0, 1.0)])
    colors = thing.data.color_attributes.new("Color", "FLOAT_COLOR", "POINT")
    for vertex, color in zip(thing.data.vertices, colors.data, strict=True):
        stripe = 0.5 + 0.5 * math.sin(20 * vertex.co.z)
        color.color = (0.55, 0.15 + 0.3 * stripe, 0.1 + 0.15 * stripe, 1)
    made = material("clay", roughness=1.0)
    node = made.node_tree.nodes.new("ShaderNodeVertexColor")
    node.layer_name = "Color"
    made.node_tree.links.new(node.outputs["Color"], made.node_tree.nodes["Principled BSDF"].inputs["Base Color"])
    return thing, made


def glossy():
    thing = lathe("glossy", arc(0.5, 0.5, 33, 0, math.pi), steps=64)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE * 2 * math.pi
    bent = np.stack([0.35 * np.sin(16 * x), 0.35 * np.sin(8 * y), np.ones_like(x)], 2)
    bent /= np.linalg.norm(bent, axis=2, keepdims=True)
    bumps = image("bumps", 0.5 + 0.5 * bent, is_data=True)
    return thing, material("lacquer", (0.05, 0.25, 0.45), roughness=0.3, normal_map=bumps)


def metal():
    ring = [(0.28 + 0.12 * math.cos(a), 0.5 + 0.5 * math.sin(a)) for a in (2 * math.pi * i / 32 for i in range(33))]
    return lathe("metal", ring), material("brass", (0.75, 0.55, 0.25), metallic=1.0, roughness=0.45)


def painted():
    rows, columns = np.mgrid[:SIZE, :SIZE] / SIZE
    print_ = np.ones((SIZE, SIZE, 3)) * (0.9, 0.85, 0.7)
    print_[(rows % 0.25) < 0.08] = (0.7, 0.1, 0.1)
    print_[((columns * 6) % 1 - 0.5) ** 2 + ((rows * 3) % 1 - 0.5) ** 2 < 0.08] = (0.1, 0.25, 0.5)
    can = [(0.0, 0.0), (0.34, 0.0), *((0.35, 0.01 + 0.98 * i / 12) for i in range(13)), (0.34, 1.0), (0.0, 1.0)]
    return lathe("painted", can), material("print", roughness=0.6, color_map=image("print", print_))


def thin():
    built = bmesh.new()
    uv = built.loops.layers.uv.new()
    steps = 24
    rows = [
        [built.verts.new((0.45 * math.sin(2.2 * (i / steps - 0.5)), 0.25 * math.cos(3 * (i / steps - 0.5)), j / 8))
         for j in range(9)]
        for i in range(steps + 1)
    ]  # fmt: skip
    for i in range(steps):
        for j in range(8):
            face = built.faces.new((rows[i][j], rows[i + 1][j], rows[i + 1][j + 1], rows[i][j + 1]))
            for loop, (a, b) in zip(face.loops, ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)), strict=True):
                loop[uv].uv = (a / steps, b / 8)
            face.smooth = True
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    checks = ((x * 8).astype(int) + (y * 8).astype(int)) % 2
    pixels = np.where(checks[..., None] > 0, (0.85, 0.8, 0.6), (0.25, 0.45, 0.3))
    return finish("thin", built), material("card", roughness=0.9, color_map=image("checks", pixels))


def concave():
    outer, inner = arc(0.5, 0.55, 17, 0.0, 1.9), arc(0.44, 0.55, 17, 1.9, 0.0)
    thing = lathe("concave", [(r, (z - 0.05) / 0.67) for r, z in [*outer, *inner]])
    y = np.mgrid[:SIZE, :SIZE][0][..., None] / SIZE
    return thing, material(
        "glaze", roughness=0.4, color_map=image("glaze", np.where(y < 0.5, (0.7, 0.7, 0.75), (0.2, 0.35, 0.5)))
    )


KINDS = (matte, glossy, metal, painted, thin, concave)


EYE, MIDDLE, FIELD = (0.9, -0.75, 1.2), (0.0, 0.0, 0.5), math.radians(70)
"""Camera of the pictures: 1.5 times a ball's radius around the meshes away, with a horizontal field of view."""
PIXELS = 320


def draw(path):
    """Draw the base colours of a .glb, as Blender imports it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    for made in bpy.data.materials:
        nodes, links = made.node_tree.nodes, made.node_tree.links
        surface = next((node for node in nodes if node.type == "BSDF_PRINCIPLED"), None)
        if surface is None:
            continue
        glow, base = nodes.new("ShaderNodeEmission"), surface.inputs["Base Color"]
        if base.links:
            links.new(base.links[0].from_socket, glow.inputs["Color"])
        else:
            glow.inputs["Color"].default_value = base.default_value
        output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
        links.new(glow.outputs["Emission"], output.inputs["Surface"])
    data = bpy.data.cameras.new("camera")
    data.angle, data.clip_start = FIELD, 0.01
    camera = bpy.data.objects.new("camera", data)
    camera.location = EYE
    camera.rotation_euler = (Vector(MIDDLE) - Vector(EYE)).to_track_quat("-Z", "Y").to_euler()
    scene = bpy.context.scene
    scene.collection.objects.link(camera)
    scene.camera, scene.world = camera, bpy.data.worlds.new("black")
    scene.world.color = (0, 0, 0)
    scene.render.engine, scene.cycles.samples = "CYCLES", 16
    scene.render.resolution_x = scene.render.resolution_y = PIXELS
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(path.with_suffix(".png"))
    bpy.ops.render.render(write_still=True)


def main(folder):
    folder.mkdir(parents=True, exist_ok=True)
    for make in KINDS:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        thing, made = make()
        thing.data.materials.append(made)
        formats = {"painted": "JPEG", "concave": "WEBP"}
        bpy.ops.export_scene.gltf(
            filepath=str(folder / f"{make.__name__}.glb"),
            export_format="GLB",
            export_image_format=formats.get(make.__name__, "AUTO"),
            export_vertex_color="MATERIAL",
        )
        draw(folder / f"{make.__name__}.glb")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
