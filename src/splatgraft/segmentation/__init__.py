"""Segment: masks of images become the Gaussians of an object. Knows nothing about files, and how scenes are made."""

from splatgraft.segmentation.birefnet import BiRefNet, load_birefnet
from splatgraft.segmentation.box import Box, default_box
from splatgraft.segmentation.grabcut import GrabcutOptions, grabcut_masks, refine_masks
from splatgraft.segmentation.lift import LiftOptions, lift_masks
from splatgraft.segmentation.segment import Segmentation, segment
from splatgraft.segmentation.selection import Keep, SelectOptions, select_object
from splatgraft.segmentation.solidify import SolidifyOptions, solidify_object
from splatgraft.segmentation.user_corrections import corrected, with_correction

__all__ = [
    "BiRefNet",
    "Box",
    "GrabcutOptions",
    "Keep",
    "LiftOptions",
    "Segmentation",
    "SelectOptions",
    "SolidifyOptions",
    "corrected",
    "default_box",
    "grabcut_masks",
    "lift_masks",
    "load_birefnet",
    "refine_masks",
    "segment",
    "select_object",
    "solidify_object",
    "with_correction",
]
