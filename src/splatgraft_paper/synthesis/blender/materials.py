"""Build shader node trees for the patterns of `synthesis.scene.Material` inside Blender."""

import bpy


class _Tree:
    """Node tree of a material, with shorthands for the nodes of patterns."""

    def __init__(self, name):
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.nodes, self.links = self.material.node_tree.nodes, self.material.node_tree.links
        self.surface = self.nodes["Principled BSDF"]
        self.coordinates = self.nodes.new("ShaderNodeTexCoord").outputs["Object"]

    def node(self, kind, inputs=None, **settings):
        made = self.nodes.new(kind)
        for key, value in settings.items():
            setattr(made, key, value)
        for key, value in (inputs or {}).items():
            self.set(made.inputs[key], value)
        return made

    def set(self, socket, value):
        if isinstance(value, bpy.types.NodeSocket):
            self.links.new(value, socket)
        else:
            socket.default_value = value

    def stretched(self, x, y, z, turn=0.0):
        mapping = self.node("ShaderNodeMapping", {"Vector": self.coordinates, "Scale": (x, y, z)})
        mapping.inputs["Rotation"].default_value = (0.0, 0.0, turn)
        return mapping.outputs["Vector"]

    def mix(self, factor, a, b, blend="MIX"):
        made = self.node("ShaderNodeMix", data_type="RGBA", blend_type=blend)
        self.set(made.inputs[0], factor)
        self.set(made.inputs[6], a)
        self.set(made.inputs[7], b)
        return made.outputs[2]

    def ramp(self, value, low, high):
        made = self.node("ShaderNodeMapRange", {"Value": value, "From Min": low, "From Max": high})
        return made.outputs["Result"]

    def noise(self, scale, vector=None, detail=6.0, roughness=0.6):
        inputs = {"Scale": scale, "Detail": detail, "Roughness": roughness, "Vector": vector or self.coordinates}
        return self.node("ShaderNodeTexNoise", inputs).outputs["Fac"]


def _opaque(color):
    return (*color, 1.0)


def _planks(tree, m, a, b):
    brick = tree.node(
        "ShaderNodeTexBrick",
        {"Vector": tree.coordinates, "Scale": m["scale"], "Mortar Size": 0.004, "Color1": a, "Color2": b,
         "Brick Width": 1.1, "Row Height": 0.14, "Mortar": (0.05, 0.03, 0.02, 1.0), "Bias": -0.1},
        offset=0.37,
    )  # fmt: skip
    grain = tree.noise(18.0 * m["scale"], tree.stretched(0.25, 4.0, 4.0), detail=8.0)
    color = tree.mix(tree.ramp(grain, 0.3, 0.75), brick.outputs["Color"], tree.mix(0.5, brick.outputs["Color"], b))
    return color, brick.outputs["Fac"], tree.ramp(grain, 0.0, 1.0)


def _wood(tree, m, a, b):
    wave = tree.node(
        "ShaderNodeTexWave",
        {"Vector": tree.stretched(0.35, 1.0, 1.0), "Scale": 3.0 * m["scale"], "Distortion": 7.0, "Detail": 3.0,
         "Detail Scale": 1.3},
        bands_direction="Y",
    )  # fmt: skip
    fiber = tree.noise(90.0, tree.stretched(0.06, 1.0, 1.0), detail=4.0)
    factor = tree.node("ShaderNodeMath", {0: wave.outputs["Fac"], 1: fiber}, operation="MULTIPLY").outputs[0]
    return tree.mix(tree.ramp(factor, 0.1, 0.75), a, b), fiber, fiber


def _tiles(tree, m, a, b):
    size = 1.0 if m["pattern"] == "tiles" else 2.2
    row = 1.0 if m["pattern"] == "tiles" else 0.45
    brick = tree.node(
        "ShaderNodeTexBrick",
        {"Vector": tree.coordinates, "Scale": m["scale"], "Mortar Size": 0.012, "Color1": a,
         "Color2": tree.mix(0.12, a, b), "Mortar": b, "Brick Width": size, "Row Height": row},
        offset=0.0 if m["pattern"] == "tiles" else 0.5,
    )  # fmt: skip
    cloud = tree.noise(9.0, detail=5.0)
    color = tree.mix(tree.ramp(cloud, 0.35, 0.9), brick.outputs["Color"], tree.mix(0.25, brick.outputs["Color"], b))
    return color, brick.outputs["Fac"], cloud


def _fabric(tree, m, a, b):
    weave = tree.noise(160.0 * m["scale"], detail=2.0)
    fold = tree.noise(3.0, detail=3.0)
    color = tree.mix(tree.ramp(weave, 0.3, 0.7), a, tree.mix(0.35, a, b))
    return tree.mix(tree.ramp(fold, 0.3, 0.8), color, tree.mix(0.2, color, b)), weave, weave


def _rug(tree, m, a, b):
    cells = tree.node("ShaderNodeTexVoronoi", {"Scale": 7.0 * m["scale"], "Vector": tree.coordinates})
    pile = tree.noise(220.0, detail=2.0)
    color = tree.mix(tree.ramp(cells.outputs["Distance"], 0.25, 0.45), a, b)
    return tree.mix(tree.ramp(pile, 0.3, 0.8), color, tree.mix(0.4, color, a)), pile, pile


def _marble(tree, m, a, b):
    warp = tree.noise(2.0 * m["scale"], detail=8.0, roughness=0.7)
    veins = tree.node(
        "ShaderNodeTexWave",
        {"Scale": 1.3 * m["scale"], "Distortion": 14.0, "Detail": 6.0, "Vector": tree.coordinates},
    )
    vein = tree.ramp(veins.outputs["Fac"], 0.86, 1.0)
    return tree.mix(vein, tree.mix(tree.ramp(warp, 0.4, 0.9), a, tree.mix(0.3, a, b)), b), warp, warp


def _cloudy(tree, m, a, b):
    coarse, fine = tree.noise(1.7 * m["scale"], detail=4.0), tree.noise(60.0 * m["scale"], detail=4.0)
    return tree.mix(tree.ramp(coarse, 0.3, 0.9), a, tree.mix(0.18, a, b)), fine, fine


def _speckle(tree, m, a, b):
    spots = tree.node("ShaderNodeTexVoronoi", {"Scale": 26.0 * m["scale"], "Vector": tree.coordinates})
    grain = tree.noise(50.0 * m["scale"])
    return tree.mix(tree.ramp(spots.outputs["Distance"], 0.3, 0.5), b, a), grain, grain


def _stripes(tree, m, a, b):
    wave = tree.node(
        "ShaderNodeTexWave",
        {"Scale": 6.0 * m["scale"], "Distortion": 0.0, "Vector": tree.coordinates},
        bands_direction="Z",
        wave_profile="SIN",
    )
    grain = tree.noise(80.0)
    return tree.mix(tree.ramp(wave.outputs["Fac"], 0.48, 0.52), a, b), grain, grain


def _checker(tree, m, a, b):
    squares = tree.node(
        "ShaderNodeTexChecker", {"Scale": 12.0 * m["scale"], "Vector": tree.coordinates, "Color1": a, "Color2": b}
    )
    grain = tree.noise(80.0)
    return squares.outputs["Color"], grain, grain


def _painting(tree, m, a, b):
    swirl = tree.noise(2.5 * m["scale"], detail=9.0, roughness=0.75)
    bands = tree.node("ShaderNodeTexMagic", {"Scale": 2.0 * m["scale"], "Distortion": 2.5, "Vector": tree.coordinates})
    return tree.mix(tree.ramp(swirl, 0.35, 0.65), tree.mix(0.5, a, bands.outputs["Color"]), b), swirl, swirl


def _grass(tree, m, a, b):
    patch, blade = tree.noise(1.1 * m["scale"], detail=5.0), tree.noise(150.0, detail=3.0)
    color = tree.mix(tree.ramp(patch, 0.35, 0.75), a, b)
    return tree.mix(tree.ramp(blade, 0.35, 0.8), tree.mix(0.6, color, (0.01, 0.015, 0.005, 1.0)), color), blade, blade


def _plain(tree, m, a, b):
    grain = tree.noise(120.0 * m["scale"], detail=2.0)
    return tree.mix(tree.ramp(grain, 0.2, 0.9), a, tree.mix(0.06, a, b)), grain, grain


_PATTERNS = {
    "planks": _planks,
    "wood": _wood,
    "tiles": _tiles,
    "brick": _tiles,
    "fabric": _fabric,
    "rug": _rug,
    "marble": _marble,
    "plaster": _cloudy,
    "speckle": _speckle,
    "stripes": _stripes,
    "checker": _checker,
    "painting": _painting,
    "grass": _grass,
    "plain": _plain,
    "metal": _plain,
}


def make(name, m):
    """Make a Blender material from the JSON form of `synthesis.scene.Material`."""
    tree = _Tree(name)
    color, height, gloss = _PATTERNS[m["pattern"]](tree, m, _opaque(m["color"]), _opaque(m["second"]))
    surface = tree.surface
    tree.set(surface.inputs["Base Color"], color)
    surface.inputs["Metallic"].default_value = m["metallic"]
    surface.inputs["Coat Weight"].default_value = m["coat"]
    surface.inputs["Coat Roughness"].default_value = 0.08
    rough = tree.node("ShaderNodeMapRange", {"Value": gloss, "To Min": max(0.02, m["roughness"] * 0.85)})
    rough.inputs["To Max"].default_value = min(1.0, m["roughness"] * 1.15)
    tree.set(surface.inputs["Roughness"], rough.outputs["Result"])
    if m["bump"] > 0:
        bump = tree.node("ShaderNodeBump", {"Strength": m["bump"], "Distance": 0.02, "Height": height})
        tree.set(surface.inputs["Normal"], bump.outputs["Normal"])
    if m["emission"] > 0:
        tree.set(surface.inputs["Emission Color"], _opaque(m["color"]))
        surface.inputs["Emission Strength"].default_value = m["emission"]
    return tree.material
