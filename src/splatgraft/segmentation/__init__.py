"""Segment: from object masks of a capture's images to the Gaussians of the object."""

from splatgraft.segmentation.birefnet import BiRefNet, load_birefnet
from splatgraft.segmentation.box import Box, default_box
from splatgraft.segmentation.grabcut import GrabcutOptions, grabcut_masks, refine_masks
from splatgraft.segmentation.lift import LiftOptions, lift_masks
from splatgraft.segmentation.segment import Segmentation, segment
from splatgraft.segmentation.selection import Keep, SelectOptions, select_object
from splatgraft.segmentation.solidify import SolidifyOptions, solidify_object
from splatgraft.segmentation.user_corrections import add_correction, apply_corrections

__all__ = [
    "BiRefNet",
    "Box",
    "GrabcutOptions",
    "Keep",
    "LiftOptions",
    "Segmentation",
    "SelectOptions",
    "SolidifyOptions",
    "add_correction",
    "apply_corrections",
    "default_box",
    "grabcut_masks",
    "lift_masks",
    "load_birefnet",
    "refine_masks",
    "segment",
    "select_object",
    "solidify_object",
]
