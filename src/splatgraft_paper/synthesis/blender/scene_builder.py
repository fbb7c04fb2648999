"""Build a scene inside Blender from the JSON form of `synthesis.scene.Scene`."""

import json
import math
import os
import random
from itertools import pairwise

import bmesh
import bpy
import materials  # a module of this folder, which the worker adds to the path
from mathutils import Euler, Vector, noise


def clear():
    """Reset Blender to factory settings without objects."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def _mesh(name, part):
    data = bpy.data.meshes.new(name)
    built = bmesh.new()
    _SHAPES[part["shape"]](built, part)
    bmesh.ops.scale(built, vec=part["size"], verts=built.verts)
    bmesh.ops.recalc_face_normals(built, faces=built.faces)
    built.to_mesh(data)
    built.free()
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


# each shape fills the unit box


def _box(built, part):
    bmesh.ops.create_cube(built, size=1.0)


def _cushion(built, part):
    """Build a box with bulging faces and a little seeded noise."""
    bmesh.ops.create_cube(built, size=1.0)
    bmesh.ops.subdivide_edges(built, edges=built.edges[:], cuts=7, use_grid_fill=True)
    for v in built.verts:
        x, y, z = (2 * c for c in v.co)
        swell = (1 - x * x) * (1 - y * y)
        v.co.z *= 0.75 + 0.45 * swell
        pinch = 1 - 0.08 * (x * x + y * y) * abs(z)
        v.co.x, v.co.y = v.co.x * pinch, v.co.y * pinch
        v.co += 0.02 * noise.noise_vector(v.co * 3.0 + Vector((part["seed"] % 97, 0, 0)))


def _sphere(built, part):
    bmesh.ops.create_uvsphere(built, u_segments=40, v_segments=24, radius=0.5)


def _cylinder(built, part):
    bmesh.ops.create_cone(built, cap_ends=True, segments=48, radius1=0.5, radius2=0.5, depth=1.0)


def _turned(built, part):
    """Build a surface of revolution about z; the profile has radii in half widths, heights in heights."""
    points = [Vector((r * 0.5, 0, h - 0.5)) for r, h in part["profile"]]
    verts = [built.verts.new(p) for p in points]
    edges = [built.edges.new(pair) for pair in pairwise(verts)]
    bmesh.ops.spin(built, geom=verts + edges, angle=2 * math.pi, steps=56, axis=(0, 0, 1), cent=(0, 0, 0))
    bmesh.ops.remove_doubles(built, verts=built.verts, dist=1e-5)


def _extruded(built, part):
    face = built.faces.new([built.verts.new((x, y, -0.5)) for x, y in part["profile"]])
    made = bmesh.ops.extrude_face_region(built, geom=[face])
    bmesh.ops.translate(built, vec=(0, 0, 1), verts=[g for g in made["geom"] if isinstance(g, bmesh.types.BMVert)])


def _blob(built, part):
    """Build a sphere displaced by seeded noise."""
    bmesh.ops.create_icosphere(built, subdivisions=4, radius=0.5)
    offset = Vector((part["seed"] % 89, part["seed"] % 53, 0))
    for v in built.verts:
        d = v.co.normalized()
        v.co = d * (0.42 + 0.16 * noise.noise(d * 1.6 + offset) + 0.05 * noise.noise(d * 5.0 + offset))


def _torus(built, part):
    """Build a torus of 40 x 16 points; `bevel` is the radius of its tube relative to the outer radius."""
    rows = []
    for a in (2 * math.pi * i / 40 for i in range(40)):
        circle = (2 * math.pi * j / 16 for j in range(16))
        radii = [(0.5 * (1 - part["bevel"] + part["bevel"] * math.cos(b)), 0.5 * math.sin(b)) for b in circle]
        rows.append([built.verts.new((r * math.cos(a), r * math.sin(a), z)) for r, z in radii])
    for row, following in zip(rows, [*rows[1:], rows[0]], strict=True):
        for j in range(16):
            n = (j + 1) % 16
            built.faces.new((row[j], following[j], following[n], row[n]))


def _tuft(built, part):
    """Build many bent blades that rise from the bottom centre."""
    rng = random.Random(part["seed"])
    for _ in range(90):
        turn, lean, length = rng.uniform(0, 2 * math.pi), rng.uniform(0.1, 1.25), rng.uniform(0.5, 1.0)
        width = rng.uniform(0.03, 0.07)
        out = Vector((math.cos(turn), math.sin(turn), 0))
        side = Vector((-out.y, out.x, 0))
        previous = None
        for step in range(6):
            t = step / 5
            bend = lean * (0.4 + 0.9 * t)
            along = out * math.sin(bend) * 0.55 + Vector((0, 0, math.cos(bend)))
            centre = Vector((0, 0, -0.5)) + length * t * along
            half = side * width * math.sin(math.pi * min(0.98, 0.15 + 0.85 * t))
            pair = (built.verts.new(centre - half), built.verts.new(centre + half))
            if previous:
                built.faces.new((previous[0], previous[1], pair[1], pair[0]))
            previous = pair


def _foliage(built, part):
    """Build many small leaves, most of them near the surface of an uneven ellipsoid."""
    rng = random.Random(part["seed"])
    leaf = 0.055 / max(part["size"])
    offset = Vector((part["seed"] % 83, part["seed"] % 47, 0))
    for _ in range(1500):
        towards = Vector((rng.gauss(0, 1), rng.gauss(0, 1), rng.gauss(0, 1))).normalized()
        reach = 0.5 * rng.uniform(0.35, 1.0) ** 0.4 * (0.8 + 0.35 * noise.noise(towards * 2.2 + offset))
        turn = Euler((rng.uniform(0, 6.3), rng.uniform(0, 6.3), rng.uniform(0, 6.3))).to_matrix()
        half = leaf * rng.uniform(0.7, 1.5)
        corners = ((-half, 0), (0, -half * 0.55), (half, 0), (0, half * 0.55))
        built.faces.new([built.verts.new(towards * reach + turn @ Vector((x, y, 0))) for x, y in corners])


_SHAPES = {
    "box": _box,
    "cushion": _cushion,
    "cylinder": _cylinder,
    "sphere": _sphere,
    "turned": _turned,
    "extruded": _extruded,
    "blob": _blob,
    "torus": _torus,
    "tuft": _tuft,
    "foliage": _foliage,
}
_SMOOTH = {"cushion", "cylinder", "sphere", "turned", "blob", "torus", "tuft"}


def add_part(part, name, meshes):
    """Add one part and return its Blender object; `meshes` caches geometry and materials of equal parts."""
    key = json.dumps({k: v for k, v in part.items() if k not in ("location", "rotation")}, sort_keys=True)
    if key in meshes:
        thing = bpy.data.objects.new(name, meshes[key])
        bpy.context.scene.collection.objects.link(thing)
    else:
        thing = _mesh(name, part)
        meshes[key] = thing.data
        _smooth(thing, part)
        thing.data.materials.append(_material(part["material"], name, meshes))
    thing.location, thing.rotation_euler = part["location"], part["rotation"]
    if part["bevel"] > 0 and part["shape"] in ("box", "extruded", "cylinder"):
        bevel = thing.modifiers.new("bevel", "BEVEL")
        bevel.width, bevel.segments, bevel.limit_method = part["bevel"], 3, "ANGLE"
    # large shapes are not subdivided, because fifty of them would take gigabytes
    if part["shape"] in ("turned", "blob") and max(part["size"]) < 0.8:
        smooth = thing.modifiers.new("smooth", "SUBSURF")
        smooth.levels = smooth.render_levels = 1
    return thing


def add_model(model):
    """Import a .glb and return its meshes; objects in Blender must have other names than those in the file."""
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=model["path"])
    made = [thing for thing in bpy.data.objects if thing not in before]
    for thing in made:
        if thing.parent is None:
            thing.location = Vector(model["location"]) + model["size"] * thing.location
            thing.scale = model["size"] * thing.scale
    return [thing for thing in made if thing.type == "MESH"]


def _smooth(thing, part):
    if part["shape"] in _SMOOTH or part["bevel"] > 0:
        for polygon in thing.data.polygons:
            polygon.use_smooth = part["shape"] in _SMOOTH and part["shape"] != "cylinder"
    if part["shape"] == "cylinder":
        for polygon in thing.data.polygons:
            polygon.use_smooth = len(polygon.vertices) == 4


def _material(description, name, cache):
    key = json.dumps(description, sort_keys=True)
    if key not in cache:
        cache[key] = materials.make(name, description)
    return cache[key]


def add_lamp(lamp, name):
    """Add one lamp."""
    data = bpy.data.lights.new(name, lamp["kind"].upper())
    data.color, data.energy = lamp["color"], lamp["power"]
    if lamp["kind"] == "sun":
        data.angle = lamp["size"]
    elif lamp["kind"] == "area":
        data.size = lamp["size"]
        if lamp["height"]:
            data.shape, data.size_y = "RECTANGLE", lamp["height"]
    else:
        data.shadow_soft_size = lamp["size"]
    thing = bpy.data.objects.new(name, data)
    thing.location = lamp["location"]
    thing.rotation_euler = Vector(lamp["direction"]).to_track_quat("-Z", "Y").to_euler()
    thing.visible_camera = False
    bpy.context.scene.collection.objects.link(thing)
    return thing


def environment_path(name):
    """Return the path of a map: an existing path, or the name of a map that comes with Blender."""
    if os.path.isabs(name) or os.path.exists(name):
        return name
    return os.path.join(bpy.utils.system_resource("DATAFILES"), "studiolights", "world", name)


def make_world(world):
    """Make a Blender world from the JSON form of `synthesis.scene.World`."""
    made = bpy.data.worlds.new("world")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    background = nodes["Background"]
    background.inputs["Strength"].default_value = world["strength"]
    background.inputs["Color"].default_value = (*world["color"], 1.0)
    if world["kind"] == "sky":
        sky = nodes.new("ShaderNodeTexSky")
        sky.sky_type, sky.sun_disc = "NISHITA", world.get("sun_disc", True)
        sky.sun_elevation, sky.sun_size, sky.dust_density = world["sun_elevation"], world["sun_size"], world["haze"]
        # the node's rotation is clockwise from +y, seen from above
        sky.sun_rotation = math.pi / 2 - world["sun_azimuth"]
        links.new(sky.outputs["Color"], background.inputs["Color"])
    elif world["kind"] == "environment":
        image = nodes.new("ShaderNodeTexEnvironment")
        image.image = bpy.data.images.load(environment_path(world["path"]))
        mapping, coordinates = nodes.new("ShaderNodeMapping"), nodes.new("ShaderNodeTexCoord")
        mapping.inputs["Rotation"].default_value = (0.0, 0.0, world["rotation"])
        links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
        links.new(mapping.outputs["Vector"], image.inputs["Vector"])
        links.new(image.outputs["Color"], background.inputs["Color"])
    return made


def add_camera(camera, name):
    """Add one camera; the object's matrix_world is its pose, OpenGL axes."""
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.angle = "HORIZONTAL", camera["field_of_view"]
    data.clip_start, data.clip_end = 0.01, 1000.0
    thing = bpy.data.objects.new(name, data)
    thing.location = camera["location"]
    look = Vector(camera["target"]) - Vector(camera["location"])
    thing.rotation_euler = look.to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(thing)
    return thing
