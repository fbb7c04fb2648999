"""Segment: masks of images become the Gaussians of an object. Knows nothing about files, and how scenes are made."""

from splatgraft.segment.birefnet import BiRefNet, load_birefnet
from splatgraft.segment.box import Box, default_box
from splatgraft.segment.corrections import corrected, with_correction
from splatgraft.segment.grabcut import GrabcutOptions, grabcut_masks, refine_masks
from splatgraft.segment.lift import LiftOptions, lift_masks
from splatgraft.segment.select import Keep, SelectOptions, select_object
from splatgraft.segment.solidify import SolidifyOptions, solidify_object

__all__ = [
    "BiRefNet",
    "Box",
    "GrabcutOptions",
    "Keep",
    "LiftOptions",
    "SelectOptions",
    "SolidifyOptions",
    "corrected",
    "default_box",
    "grabcut_masks",
    "lift_masks",
    "load_birefnet",
    "refine_masks",
    "select_object",
    "solidify_object",
    "with_correction",
]
