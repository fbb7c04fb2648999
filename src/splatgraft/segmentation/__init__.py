"""Segment: from object masks of a capture's images to the Gaussians of the object."""

from splatgraft.segmentation.birefnet import BiRefNet, load_birefnet
from splatgraft.segmentation.box import Box
from splatgraft.segmentation.cut_object import CutMasks, CutOptions, CutViews, FirstGuess, cut_object
from splatgraft.segmentation.grabcut import GrabCut
from splatgraft.segmentation.lift import LiftOptions, lift_masks
from splatgraft.segmentation.mask_agreement import LEAST_AGREEMENT, Agreement, measure_agreement
from splatgraft.segmentation.object_region import ObjectRegion, default_box
from splatgraft.segmentation.sam2 import Sam2, load_sam2
from splatgraft.segmentation.seed_selection import Seed, seed_selection
from splatgraft.segmentation.segment import Segmentation, segment
from splatgraft.segmentation.selection import Keep, SelectOptions, select_object
from splatgraft.segmentation.solidify import SolidifyOptions, solidify_object
from splatgraft.segmentation.user_corrections import add_correction, apply_corrections
from splatgraft.segmentation.view_cutter import Evidence, ViewCutter

__all__ = [
    "LEAST_AGREEMENT",
    "Agreement",
    "BiRefNet",
    "Box",
    "CutMasks",
    "CutOptions",
    "CutViews",
    "Evidence",
    "FirstGuess",
    "GrabCut",
    "Keep",
    "LiftOptions",
    "ObjectRegion",
    "Sam2",
    "Seed",
    "Segmentation",
    "SelectOptions",
    "SolidifyOptions",
    "ViewCutter",
    "add_correction",
    "apply_corrections",
    "cut_object",
    "default_box",
    "lift_masks",
    "load_birefnet",
    "load_sam2",
    "measure_agreement",
    "seed_selection",
    "segment",
    "select_object",
    "solidify_object",
]
