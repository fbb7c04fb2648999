"""Capture: photos, a video or a scene without either become posed images. Trains nothing."""

from splatgraft.capture.orientation import upright
from splatgraft.capture.structure_from_motion import PoseOptions, PoseReport, pose_photos
from splatgraft.capture.video import extract_frames
from splatgraft.capture.virtual_cameras import LookOptions, Viewpoints, find_viewpoints, photographed

__all__ = [
    "LookOptions",
    "PoseOptions",
    "PoseReport",
    "Viewpoints",
    "extract_frames",
    "find_viewpoints",
    "photographed",
    "pose_photos",
    "upright",
]
