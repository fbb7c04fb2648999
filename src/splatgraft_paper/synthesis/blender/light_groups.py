"""Puts every lamp into a light group of its own, so that one render gives the light of each. Runs inside Blender."""

import bpy

WORLD = "world"


def assign(things):
    """Assign groups to lamps, glowing meshes and the world; returns the groups' names.

    A glowing mesh is the shade of the lamp nearest to it.
    """
    lamps = [thing for thing in things if thing.type == "LIGHT"]
    for name in (WORLD, *(thing.name for thing in lamps)):
        bpy.context.view_layer.lightgroups.add(name=name)
    for thing in lamps:
        thing.lightgroup = thing.name
    for thing in things:
        if thing.type == "MESH" and any(_glows(material) for material in thing.data.materials):
            nearest = min(lamps, key=lambda lamp: (lamp.location - thing.location).length, default=None)
            thing.lightgroup = WORLD if nearest is None else nearest.name
    return names()


def _glows(material):
    surface = material.node_tree.nodes.get("Principled BSDF")
    return surface is not None and surface.inputs["Emission Strength"].default_value > 0


def names():
    """The groups of the view layer; none where `assign` was not called."""
    return [group.name for group in bpy.context.view_layer.lightgroups]
