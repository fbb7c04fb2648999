"""Drive the add-on in Blender as a Python module like a user, and write down the resulting scene. Runs in Blender.

drive_addon.py ADDON COMMAND PROJECT TARGET FOLDER OUT: FOLDER holds bare.ply, the target's scene alone, and bare.glb.
"""

import importlib.util
import json
import math
import sys
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector


def main(addon_file, command, source, target, folder, out):
    spec = importlib.util.spec_from_file_location("splatgraft_addon", addon_file)
    addon = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(addon)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon.register()
    found = {}
    settings = bpy.context.scene.splatgraft
    settings.command, settings.folder, settings.source, settings.target = command, folder, source, folder
    found["refused"] = refused("load")
    found |= target_alone(addon, settings, target)
    # an object and a scene without captures
    settings.source = str(Path(source) / "object" / "object.ply")
    settings.target, settings.folder = str(Path(folder) / "bare.ply"), str(Path(folder) / "bare")
    run(addon, "load")
    found["bare"] = world_points(addon.find("target"))
    settings.source, settings.target, settings.folder = source, target, folder
    run(addon, "load")
    found["loaded"] = settings.status
    root, box, thing = (addon.find(part) for part in ("root", "box", "object"))
    found["target"] = world_points(addon.find("target"))
    found["height"] = float(np.ptp(np.array(world_points(thing))[:, 2]))
    # a box with uneven scale is refused before anything runs
    box.scale = (1.0, 2.0, 1.0)
    found["sheared"] = refused("relight")
    box.location, box.rotation_mode, box.scale = (0.2, -0.1, 0.35), "XYZ", (0.6, 0.6, 0.6)
    box.rotation_euler = Euler((0.1, -0.2, 0.9))
    # the user may turn and enlarge the whole capture
    root.matrix_world = Matrix.Rotation(0.5, 4, "X") @ Matrix.Rotation(-1.1, 4, "Z") @ Matrix.Scale(2.0, 4)
    bpy.context.view_layer.update()
    found["placed"] = world_points(thing)
    assert bpy.ops.splatgraft.relight() == {"FINISHED"}
    found["while it runs"] = refused("relight")
    finish(addon)
    found["relit"], found["status"] = world_points(addon.find("relit")), settings.status
    found["root"] = [list(row) for row in root.matrix_world]
    found["hidden"] = [addon.find("target").hide_render, thing.hide_render]
    lamps = [one for one in bpy.data.objects if one.get("splatgraft") == "lamp"]
    found["lamps"] = [described(lamp) for lamp in lamps]
    found["world"] = render_world()
    found["level"] = [render_level(addon, root, away) for away in (None, 3.0)]
    found["blocks"] = addon.find("relit").visible_shadow or addon.find("relit").visible_diffuse
    found["attributes"] = [one.name for one in addon.find("relit").data.attributes]
    # a failed command's line is shown
    Path(folder, "light.json").rename(Path(folder, "lamps.json"))
    settings.source = str(Path(out).with_suffix(".ply"))
    Path(settings.source).write_text("no scene")
    bpy.ops.splatgraft.relight()
    finish(addon)
    found["failed"] = settings.status
    addon.unregister()
    bpy.ops.import_scene.gltf(filepath=str(Path(folder) / "bare.glb"))
    found["glb"] = world_points(bpy.context.object)
    Path(out).write_text(json.dumps(found))


def target_alone(addon, settings, target):
    """Load a target without an object, and light a place in it."""
    settings.source, settings.target = "", target
    run(addon, "load")
    loaded = [settings.status, addon.find("object") is None, addon.find("target").type]
    addon.find("box").matrix_world = Matrix.Translation((-0.2, 0.1, 0.3))
    run(addon, "relight")
    bpy.context.view_layer.update()
    lamps = [described(one) for one in bpy.data.objects if one.get("splatgraft") == "lamp"]
    shown = [settings.status, addon.find("target").hide_render, bpy.context.scene.world.name]
    return {"loaded alone": loaded, "lamps alone": lamps, "shown alone": shown}


def refused(name):
    try:
        getattr(bpy.ops.splatgraft, name)()
    except RuntimeError as error:
        return str(error)
    return ""


def run(addon, name):
    assert getattr(bpy.ops.splatgraft, name)() == {"FINISHED"}
    finish(addon)


def finish(addon):
    """Run Blender's timers, because a module without a window has no loop that does."""
    while addon.Job.poll() is not None:
        time.sleep(0.05)


def world_points(thing):
    bpy.context.view_layer.update()
    positions = thing.data.attributes["position"].data  # of a mesh's vertices, or of a point cloud
    points = np.zeros((len(positions), 3), np.float32)
    positions.foreach_get("vector", points.ravel())
    matrix = np.array(thing.matrix_world)
    return (points @ matrix[:3, :3].T + matrix[:3, 3]).tolist()


def described(lamp):
    towards = lamp.matrix_world.to_3x3().normalized() @ Vector((0, 0, 1))
    return {
        "towards": list(towards),
        "kind": lamp.data.type,
        "energy": lamp.data.energy,
        "color": list(lamp.data.color),
    }


def render(camera, width, height, samples):
    """Return linear rgb, top row first."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device, scene.cycles.samples, scene.camera = "CYCLES", "CPU", samples, camera
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(Path(sys.argv[6]).with_suffix(".exr"))
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


def new_camera(location, rotation):
    thing = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    thing.location, thing.rotation_euler = location, rotation
    bpy.context.scene.collection.objects.link(thing)
    return thing


def render_world():
    """Render a panorama of the world alone: top +z, middle +x, to the right -y."""
    camera = new_camera((0, 0, 0), (math.pi / 2, 0, -math.pi / 2))
    camera.data.type, camera.data.panorama_type = "PANO", "EQUIRECTANGULAR"
    things = [one for one in bpy.data.objects if one.type in ("MESH", "POINTCLOUD", "LIGHT") and not one.hide_render]
    for one in things:
        one.hide_render = True
    panorama = render(camera, 64, 32, 16)
    for one in things:
        one.hide_render = False
    return panorama.tolist()


def render_level(addon, root, away):
    """Return mean radiance of a white plane under a lamp of irradiance (1, .5, .25), at a distance or at infinity."""
    for one in bpy.data.objects:
        one.hide_render = True
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    before = set(bpy.data.objects)
    lamp = {"name": "test", "direction": [0.6, 0.0, 0.8], "irradiance": [1.0, 0.5, 0.25], "angular_radius_deg": 1.0}
    addon._add_lamp(lamp if away is None else lamp | {"distance": away}, root, Vector((0.3, 0.2, 0.1)))
    bpy.context.view_layer.update()
    (light,) = (one for one in bpy.data.objects if one not in before)
    center = root.matrix_world @ Vector((0.3, 0.2, 0.1))
    turn = light.matrix_world.to_3x3().normalized().to_euler()
    corners = [(-0.1, -0.1, 0), (0.1, -0.1, 0), (0.1, 0.1, 0), (-0.1, 0.1, 0)]
    mesh = bpy.data.meshes.new("plane")
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("white")
    material.use_nodes = True
    white = material.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
    white.inputs["Color"].default_value = (1, 1, 1, 1)
    material.node_tree.links.new(white.outputs[0], material.node_tree.nodes["Material Output"].inputs["Surface"])
    mesh.materials.append(material)
    plane = bpy.data.objects.new("plane", mesh)
    plane.location, plane.rotation_euler = center, turn
    bpy.context.scene.collection.objects.link(plane)
    camera = new_camera(center + turn.to_matrix() @ Vector((0, 0, 0.5)), turn)
    camera.data.type, camera.data.ortho_scale = "ORTHO", 0.1
    found = render(camera, 8, 8, 64).reshape(-1, 3).mean(0)
    bpy.data.objects.remove(light)
    return found.tolist()


if __name__ == "__main__":
    main(*sys.argv[1:7])
