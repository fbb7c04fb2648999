"""Capture: photos, a video or a scene without either become posed images. Trains nothing."""

from splatgraft.capture.orientation import upright
from splatgraft.capture.plausibility import Doubt, Found, Lens, Plausible, find_doubts
from splatgraft.capture.pose_report import POSE_REPORT_FILE, PoseReport, read_pose_report, write_pose_report
from splatgraft.capture.structure_from_motion import PoseOptions, pose_photos
from splatgraft.capture.video import extract_frames
from splatgraft.capture.virtual_cameras import LookOptions, Viewpoints, find_viewpoints, photographed

__all__ = [
    "POSE_REPORT_FILE",
    "Doubt",
    "Found",
    "Lens",
    "LookOptions",
    "Plausible",
    "PoseOptions",
    "PoseReport",
    "Viewpoints",
    "extract_frames",
    "find_doubts",
    "find_viewpoints",
    "photographed",
    "pose_photos",
    "read_pose_report",
    "upright",
    "write_pose_report",
]
