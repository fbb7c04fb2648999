# SPDX-License-Identifier: Apache-2.0
"""Blender add-on: show a Gaussian splat capture with its light, or insert an object of another one, lit by its place.

It calls the command line (`splatgraft capture`, `adopt`, `relight`, `light`) in the background and imports the files
that it writes. Everything of the target has one empty as its parent. The local axes of the empty are those of the
target's capture, so that splats and lamps follow when it is moved, turned or scaled.
"""

import itertools
import json
import math
import os
import shutil
import subprocess
import time
from pathlib import Path

import bpy
import numpy as np
from bpy.props import PointerProperty, StringProperty
from mathutils import Matrix, Vector

bl_info = {
    "name": "Splatgraft: insert an object from a capture",
    "author": "the splatgraft authors",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "3D Viewport > Sidebar > Splatgraft",
    "description": "Places an object of one Gaussian splat capture in another and gives it the light there",
    "category": "Import-Export",
}

_SH_C0 = 0.28209479177387814  # spherical harmonic of degree 0, the factor from f_dc to colour
_NATIVE_SPLATS = (5, 3, 0)  # first Blender whose own .ply importer makes Gaussian splats
_STRAY = 1.0  # percent of an object's points, on either side, that its box may leave out
_RIGID = 1e-3  # largest relative difference of an axis's scale, and cosine between axes, that are rounding
_SECONDS = 0.5  # between two checks of the running command


class Job:
    """Commands that run one after another in the background; the panel shows the last line of their log."""

    running: "Job | None" = None

    def __init__(self, commands, log, done):
        """Run `commands`, lists of words, one after another until one fails; after the last one call `done`."""
        self.commands, self.log, self.done, self.process = list(commands), log, done, None
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text("", "utf-8")
        Job.running = self
        bpy.app.timers.register(Job.poll, first_interval=0.0)

    @staticmethod
    def poll():
        """Advance the running job, as Blender's timer; gives the seconds to the next call, or None at the end."""
        job, state = Job.running, bpy.context.scene.splatgraft
        if job is None:
            return None
        try:
            goes_on = job._step(state)
        except (OSError, RuntimeError, ValueError, LookupError, AttributeError, StopIteration) as error:
            state.status, goes_on = f"failed: {error}", False
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()
        if not goes_on:
            Job.running = None
        return _SECONDS if goes_on else None

    def _step(self, state):
        if self.process is not None:
            code = self.process.poll()
            said = [line.strip() for line in self.log.read_text("utf-8", errors="replace").splitlines() if line.strip()]
            state.status = said[-1] if said else "begins"
            if code is None:
                return True
            if code != 0:
                raise RuntimeError(state.status.removeprefix("splatgraft: "))
        if not self.commands:
            # importers need a window, which a timer does not have
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
                state.status = self.done()
            return False
        with self.log.open("a", encoding="utf-8") as log:
            self.process = subprocess.Popen(self.commands.pop(0), stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        return True

    def stop(self):
        """End the running command; its unfinished result is discarded, and earlier results stay."""
        Job.running = None
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()


class Settings(bpy.types.PropertyGroup):
    """Settings of the panel, stored in the .blend."""

    command: StringProperty(
        name="Command", subtype="FILE_PATH", default="splatgraft", description="splatgraft's program"
    )
    source: StringProperty(
        name="Object",
        subtype="FILE_PATH",
        description="A splatgraft project, for its object, or an object's .ply; empty for the target's light alone",
    )
    target: StringProperty(
        name="Target", subtype="FILE_PATH", description="A trained scene (.ply, .spz, .glb, ...), or a project's folder"
    )
    folder: StringProperty(
        name="Results", subtype="DIR_PATH", default="//splatgraft", description="A folder of its own"
    )
    status: StringProperty(default="")


class Paths:
    """The files that the settings name."""

    def __init__(self, settings):
        """Find the files; ValueError if one is missing."""
        self.command = shutil.which(bpy.path.abspath(settings.command)) or shutil.which(settings.command)
        if self.command is None:
            raise ValueError(f"Command: expected the program splatgraft, found no {settings.command}")
        if settings.folder.startswith("//") and not bpy.data.filepath:
            raise ValueError("Results: expected a folder, or a .blend that was saved, found neither")
        self.folder = Path(bpy.path.abspath(settings.folder)).resolve()
        source, target = (Path(bpy.path.abspath(path)) for path in (settings.source, settings.target))
        self.has_object = bool(settings.source)
        self.object = source / "object" / "object.ply" if source.is_dir() else source
        if self.has_object and (not self.object.is_file() or self.object.suffix != ".ply"):
            raise ValueError(f"Object: expected a project with object/object.ply, or a .ply, found {settings.source!r}")
        self.surroundings = self.object.with_name("surroundings.ply") if self.has_object else self.object
        self.object_cameras = self.object.parent.parent / "source" / "capture" / "transforms.json"
        self.knows_source = self.surroundings.is_file() and self.object_cameras.is_file()
        self.given_target = target / "target" / "scene" / "scene.ply" if target.is_dir() else target
        if not self.given_target.is_file():
            raise ValueError(f"Target: expected a scene or a project with target/scene, found {settings.target!r}")
        self.target, self.cameras = self.given_target, target.parent.parent / "capture" / "transforms.json"
        if target.is_dir():
            self.cameras = target / "target" / "capture" / "transforms.json"
        self.is_trained_elsewhere = not self.cameras.is_file()
        if self.is_trained_elsewhere:
            self.target = self.folder / "target" / "scene" / "scene.ply"
            self.cameras = self.folder / "target" / "capture" / "transforms.json"
        self.placement, self.relit = self.folder / "placement.json", self.folder / "relit" / "scene.ply"
        self.map, self.lamps = self.folder / "light.hdr", self.folder / "light.json"

    def preparing(self):
        """Return the commands that make cameras for a scene without a capture, and a .ply in their axes."""
        given, made = str(self.given_target), self.target.parent
        if not self.is_trained_elsewhere:
            return []
        return [
            [self.command, "capture", given, "--out", str(self.cameras.parent)],
            [self.command, "adopt", given, "--capture", str(self.cameras.parent), "--out", str(made)],
        ]

    def relighting(self):
        """Return the commands that relight the object at its box and write the light there."""
        light = [self.command, "light", str(self.target), "--out", str(self.map), "--frame", "capture"]
        light += ["--cameras", str(self.cameras)]
        if not self.has_object:
            place, radius = place_of_ball()
            return [[*light, "--radius", str(radius), "--at", *map(str, place)]]
        write_placement(self)
        relight = [self.command, "relight", "--target", str(self.target), "--cameras", str(self.cameras)]
        relight += ["--placement", str(self.placement), "--out", str(self.relit.parent)]
        if self.knows_source:
            relight += ["--surroundings", str(self.surroundings), "--object-cameras", str(self.object_cameras)]
        return [relight, [*light, "--placement", str(self.placement)]]


def find(part):
    """Find the Blender object of a part: root, target, object, box, relit; None if it is missing."""
    return next((thing for thing in bpy.context.scene.objects if thing.get("splatgraft") == part), None)


def import_splats(path, part):
    """Import a Gaussian .ply as `part`, in its own axes, by the best installed importer; gives it and its kind."""
    before = set(bpy.data.objects)
    kiri = next((name for name in dir(bpy.ops.sna) if name.startswith("dgs_render_import_ply")), None)
    if bpy.app.version < _NATIVE_SPLATS and kiri is not None:
        getattr(bpy.ops.sna, kiri)("EXEC_DEFAULT", filepath=str(path))
        said = "splats of KIRI 3DGS Render"
    else:
        bpy.ops.wm.ply_import(filepath=str(path))
        said = "Blender's splats"
    thing = next(new for new in bpy.data.objects if new not in before)
    if said == "Blender's splats" and thing.type == "MESH":
        _show_as_points(thing)
        said = "coloured points, because neither Blender 5.3 nor the add-on KIRI 3DGS Render is here"
    thing.name, thing["splatgraft"] = f"splatgraft {part}", part
    # the map and the lamps light meshes; the splats must not block that light or add to it
    thing.visible_shadow = thing.visible_diffuse = thing.visible_glossy = thing.visible_transmission = False
    return thing, said


def _show_as_points(thing):
    """Give a mesh of Gaussians a colour attribute, and show its vertices as points of that colour."""
    mesh, count = thing.data, len(thing.data.vertices)
    values = {name: np.zeros(count, np.float32) for name in ("f_dc_0", "f_dc_1", "f_dc_2", "scale_0")}
    for name, array in values.items():
        mesh.attributes[name].data.foreach_get("value", array)
    srgb = np.clip(0.5 + _SH_C0 * np.stack([values[f"f_dc_{i}"] for i in range(3)], 1), 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    colors = mesh.color_attributes.new("Col", "FLOAT_COLOR", "POINT")
    colors.data.foreach_set("color", np.concatenate([linear, np.ones((count, 1))], 1).astype(np.float32).ravel())
    material = bpy.data.materials.get("splatgraft points") or bpy.data.materials.new("splatgraft points")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    color, glow = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeEmission")
    color.attribute_name = "Col"
    links.new(color.outputs["Color"], glow.inputs["Color"])
    links.new(glow.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    tree = bpy.data.node_groups.new("splatgraft points", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeMeshToPoints", "GeometryNodeSetMaterial", "NodeGroupOutput")
    chain = [tree.nodes.new(kind) for kind in kinds]
    chain[1].inputs["Radius"].default_value = float(np.exp(np.median(values["scale_0"])))
    chain[2].inputs["Material"].default_value = material
    for first, second in itertools.pairwise(chain):
        tree.links.new(first.outputs[0], next(s for s in second.inputs if s.type == "GEOMETRY"))
    thing.modifiers.new("points", "NODES").node_group = tree


def _positions(thing):
    found = np.zeros((len(thing.data.attributes["position"].data), 3), np.float32)
    thing.data.attributes["position"].data.foreach_get("vector", found.ravel())
    return found


def upright_from_capture(cameras):
    """Compute the smallest rotation (4x4) from a capture's up, the mean of its cameras', to +z; the default is -y."""
    up = Vector((0.0, -1.0, 0.0))
    if cameras.is_file():
        frames = json.loads(cameras.read_text("utf-8"))["frames"]
        up = Vector(np.mean([np.asarray(frame["transform_matrix"])[:3, 1] for frame in frames], 0))
    return up.rotation_difference(Vector((0.0, 0.0, 1.0))).to_matrix().to_4x4()


def _remove(*parts):
    for thing in [one for one in bpy.data.objects if one.get("splatgraft") in parts]:
        bpy.data.objects.remove(thing, do_unlink=True)


def show_parts(paths):
    """Import target and object, upright, with a box that moves the object; gives a message for the panel."""
    _remove("root", "target", "object", "box", "relit", "lamp")
    root = bpy.data.objects.new("splatgraft target frame", None)
    root["splatgraft"] = "root"
    bpy.context.scene.collection.objects.link(root)
    root.matrix_world = upright_from_capture(paths.cameras)
    target, said = import_splats(paths.target, "target")
    target.parent = root
    upright = _positions(target) @ np.array(root.matrix_world.to_3x3()).T
    box = _object_in_box(paths) if paths.has_object else _place_marker(upright)
    box.matrix_world = Matrix.Translation(Vector(np.median(upright, 0)))
    bpy.context.view_layer.update()
    box.parent, box.matrix_parent_inverse = root, root.matrix_world.inverted()
    bpy.context.view_layer.objects.active = box
    if not paths.has_object:
        return f"{said}; move the ball to where a mesh will stand, then Relight"
    return f"{said}; move, turn and scale the box (captures have no common unit), then Relight"


def _new_box(name, mesh):
    box = bpy.data.objects.new(name, mesh)
    box["splatgraft"] = "box"
    bpy.context.scene.collection.objects.link(box)
    return box


def _place_marker(points):
    """Make a ball that marks a place, a twentieth as wide as the middle half of the points."""
    marker = _new_box("splatgraft place: move me", None)
    marker.empty_display_type = "SPHERE"
    marker.empty_display_size = float(np.ptp(np.percentile(points, [25, 75], axis=0), axis=0).max()) / 40
    return marker


def _object_in_box(paths):
    """Import the object, upright, as the child of a box around it."""
    thing, _ = import_splats(paths.object, "object")
    low, high = np.percentile(_positions(thing), [_STRAY, 100 - _STRAY], axis=0)
    # the box surrounds the upright points; its frame is the object's, with the origin in the middle
    middle = Matrix.Translation(Vector(0.5 * (low + high)))
    inner = upright_from_capture(paths.object_cameras if paths.knows_source else Path()) @ middle.inverted()
    points = _positions(thing) @ np.array(inner.to_3x3()).T + np.array(inner.translation)
    low, high = np.percentile(points, [_STRAY, 100 - _STRAY], axis=0)
    mesh = bpy.data.meshes.new("splatgraft box")
    corners = [[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)]
    mesh.from_pydata(corners, [(i, i | 1 << axis) for i in range(8) for axis in range(3) if not i >> axis & 1], [])
    box = _new_box("splatgraft object: move me", mesh)
    thing.parent, thing.matrix_local = box, inner
    return box


def place_of_ball():
    """Return the middle and the radius of the ball in the target's capture."""
    root, box = find("root"), find("box")
    if root is None or box is None or box.type != "EMPTY":
        raise ValueError("Relight: expected a target without an object in the scene, found none; press Load first")
    bpy.context.view_layer.update()
    matrix = root.matrix_world.inverted() @ box.matrix_world
    return tuple(matrix.translation), box.empty_display_size * matrix.median_scale


def target_from_object():
    """Compute scale, rotation (3x3) and translation of the object in the target's capture; ValueError if sheared."""
    root, thing = find("root"), find("object")
    if root is None or thing is None:
        raise ValueError("Relight: expected a target and an object in the scene, found none; press Load first")
    bpy.context.view_layer.update()
    matrix = np.array(root.matrix_world.inverted() @ thing.matrix_world, np.float64)
    axes = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(axes)))
    if not scale > 0 or np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() > _RIGID:
        raise ValueError(
            "Relight: expected one scale for all axes of the box and no mirroring, found another transform"
        )
    # the nearest rotation, because Blender has single precision
    left, _, right = np.linalg.svd(axes)
    return scale, left @ right, matrix[:3, 3]


def write_placement(paths):
    """Write placement.json from the box's transform."""
    scale, rotation, translation = target_from_object()
    named = os.path.relpath(paths.object, paths.folder)
    placed = {"object": named, "scale": scale, "rotation": rotation.tolist(), "translation": translation.tolist()}
    paths.placement.write_text(json.dumps({"objects": [placed]}, indent=1), "utf-8")


def show_result(paths):
    """Import the relit scene in place of its parts, the lamps and the world; gives a message for the panel."""
    _remove("relit", "lamp")
    root, said = find("root"), "the light at the ball"
    if paths.has_object:
        relit, said = import_splats(paths.relit, "relit")
        relit.parent = root
        for part in ("target", "object"):
            find(part).hide_viewport = find(part).hide_render = True
    place = root.matrix_world.inverted() @ find("box").matrix_world.translation
    lamps = json.loads(paths.lamps.read_text("utf-8"))["sources"]
    for lamp in lamps:
        _add_lamp(lamp, root, place)
    _set_world(paths.map, root)
    return f"{said}; {len(lamps)} lamps; made at {time.strftime('%H:%M')}"


def _add_lamp(lamp, root, place):
    """Add a sun, or a ball of light for a lamp at a distance, in the root's axes."""
    towards, away = Vector(lamp["direction"]), lamp.get("distance")
    strength, radius = max(lamp["irradiance"]), math.radians(lamp.get("angular_radius_deg", 0.0))
    light = bpy.data.lights.new(f"splatgraft {lamp['name']}", "SUN" if away is None else "POINT")
    light.color = [channel / max(strength, 1e-9) for channel in lamp["irradiance"]]
    if away is None:
        light.energy, light.angle = strength, 2 * radius
    else:
        metres = away * root.matrix_world.median_scale
        light.energy, light.shadow_soft_size = 4 * math.pi * metres**2 * strength, metres * math.tan(radius)
    thing = bpy.data.objects.new(light.name, light)
    thing["splatgraft"] = "lamp"
    bpy.context.scene.collection.objects.link(thing)
    thing.parent = root
    turn = towards.to_track_quat("Z", "Y").to_matrix().to_4x4()
    thing.matrix_local = Matrix.Translation(place + towards * (1.0 if away is None else away)) @ turn


def _set_world(path, root):
    """Make the environment map the scene's world, turned as the root is."""
    world = bpy.data.worlds.get("splatgraft") or bpy.data.worlds.new("splatgraft")
    bpy.context.scene.world, world.use_nodes = world, True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    kinds = ("TexCoord", "Mapping", "TexEnvironment", "Background", "OutputWorld")
    start, mapping, image, background, end = (nodes.new(f"ShaderNode{kind}") for kind in kinds)
    image.image = bpy.data.images.load(str(path), check_existing=True)
    image.image.reload()
    mapping.inputs["Rotation"].default_value = root.matrix_world.to_quaternion().inverted().to_euler()
    links.new(start.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], end.inputs["Surface"])


class SPLATGRAFT_OT_load(bpy.types.Operator):
    """Show target and object; for a scene without a capture, cameras all around it are made first"""

    bl_idname, bl_label = "splatgraft.load", "Load"

    def execute(self, context):
        return _begin(self, context, lambda paths: paths.preparing(), show_parts)


class SPLATGRAFT_OT_relight(bpy.types.Operator):
    """Give the object the light at the place of its box, and the place the object's shadow; set lamps and World"""

    bl_idname, bl_label = "splatgraft.relight", "Relight"

    def execute(self, context):
        return _begin(self, context, lambda paths: paths.relighting(), show_result)


class SPLATGRAFT_OT_stop(bpy.types.Operator):
    """End the running command"""

    bl_idname, bl_label = "splatgraft.stop", "Stop"

    def execute(self, context):
        if Job.running is not None:
            Job.running.stop()
            context.scene.splatgraft.status = "stopped"
        return {"FINISHED"}


def _begin(operator, context, commands, done):
    try:
        if Job.running is not None:
            raise ValueError("a command is running; wait, or press Stop")
        paths = Paths(context.scene.splatgraft)
        paths.folder.mkdir(parents=True, exist_ok=True)
        Job(commands(paths), paths.folder / "splatgraft.log", lambda: done(paths))
    except (OSError, ValueError) as error:
        operator.report({"ERROR"}, str(error))
        context.scene.splatgraft.status = str(error)
        return {"CANCELLED"}
    context.scene.splatgraft.status = "begins"
    return {"FINISHED"}


class SPLATGRAFT_PT_panel(bpy.types.Panel):
    """The panel in the sidebar."""

    bl_label, bl_space_type, bl_region_type, bl_category = "Splatgraft", "VIEW_3D", "UI", "Splatgraft"

    def draw(self, context):
        settings, column = context.scene.splatgraft, self.layout.column()
        for name in ("source", "target", "folder", "command"):
            column.prop(settings, name)
        if Job.running is None:
            column.operator("splatgraft.load", icon="IMPORT")
            column.operator("splatgraft.relight", icon="LIGHT_SUN")
        else:
            column.operator("splatgraft.stop", icon="CANCEL")
        for i in range(0, len(settings.status), 40):
            column.label(text=settings.status[i : i + 40])


_CLASSES = (Settings, SPLATGRAFT_OT_load, SPLATGRAFT_OT_relight, SPLATGRAFT_OT_stop, SPLATGRAFT_PT_panel)


def register():
    for kind in _CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.splatgraft = PointerProperty(type=Settings)


def unregister():
    if Job.running is not None:
        Job.running.stop()
    while bpy.app.timers.is_registered(Job.poll):
        bpy.app.timers.unregister(Job.poll)
    del bpy.types.Scene.splatgraft
    for kind in reversed(_CLASSES):
        bpy.utils.unregister_class(kind)
