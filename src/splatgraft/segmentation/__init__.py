"""Segmentation: object masks of a capture's images, and the object's Gaussians."""

from splatgraft.segmentation.capture_masks import CUT_SIDE_PX, CutRequest, cut_capture, network_masks
from splatgraft.segmentation.cut_object import (
    MIN_AGREEMENT,
    Agreement,
    CutViews,
    ViewCutter,
    cut_object,
    measure_agreement,
)
from splatgraft.segmentation.grabcut import grabcut_mask
from splatgraft.segmentation.lift import LiftOptions, lift_masks
from splatgraft.segmentation.object_region import ObjectRegion, default_box, seed_selection
from splatgraft.segmentation.onnx_networks import load_birefnet, load_sam2
from splatgraft.segmentation.segment import Segmentation, segment
from splatgraft.segmentation.selection import (
    Box,
    Keep,
    SelectOptions,
    add_correction,
    apply_corrections,
    part_shares,
    select_object,
)
from splatgraft.segmentation.solidify import SolidifyOptions, solidify_object
from splatgraft.segmentation.unseen_side import ClosedObject, close_unseen_side

__all__ = [
    "CUT_SIDE_PX",
    "MIN_AGREEMENT",
    "Agreement",
    "Box",
    "ClosedObject",
    "CutRequest",
    "CutViews",
    "Keep",
    "LiftOptions",
    "ObjectRegion",
    "Segmentation",
    "SelectOptions",
    "SolidifyOptions",
    "ViewCutter",
    "add_correction",
    "apply_corrections",
    "close_unseen_side",
    "cut_capture",
    "cut_object",
    "default_box",
    "grabcut_mask",
    "lift_masks",
    "load_birefnet",
    "load_sam2",
    "measure_agreement",
    "network_masks",
    "part_shares",
    "seed_selection",
    "segment",
    "select_object",
    "solidify_object",
]
