"""Capture: posed images from photos, from a video, or from a trained scene that comes without images."""

from splatgraft.capture.metric_scale import FoundScale, scale_from_length, scale_from_marker, triangulate
from splatgraft.capture.orientation import upright
from splatgraft.capture.plausibility import Doubt, Found, Lens, Plausible, find_doubts
from splatgraft.capture.pose_report import POSE_REPORT_FILE, PoseReport, Unposed, read_pose_report, write_pose_report
from splatgraft.capture.structure_from_motion import PoseOptions, pose_photos
from splatgraft.capture.video import extract_frames
from splatgraft.capture.virtual_cameras import (
    VirtualCameraOptions,
    VirtualCameras,
    place_virtual_cameras,
    render_pictures,
)

__all__ = [
    "POSE_REPORT_FILE",
    "Doubt",
    "Found",
    "FoundScale",
    "Lens",
    "Plausible",
    "PoseOptions",
    "PoseReport",
    "Unposed",
    "VirtualCameraOptions",
    "VirtualCameras",
    "extract_frames",
    "find_doubts",
    "place_virtual_cameras",
    "pose_photos",
    "read_pose_report",
    "render_pictures",
    "scale_from_length",
    "scale_from_marker",
    "triangulate",
    "upright",
    "write_pose_report",
]
