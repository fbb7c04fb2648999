"""Capture: photos or a video become posed images. Knows nothing about Gaussians."""

from splatgraft.capture.orientation import upright
from splatgraft.capture.structure_from_motion import PoseOptions, PoseReport, pose_photos
from splatgraft.capture.video import extract_frames

__all__ = ["PoseOptions", "PoseReport", "extract_frames", "pose_photos", "upright"]
