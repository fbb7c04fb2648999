"""Capture: posed images from photos, from a video, or from a trained scene that comes without images."""

from splatgraft.capture.orientation import upright
from splatgraft.capture.structure_from_motion import PoseOptions, PoseReport, pose_photos
from splatgraft.capture.video import extract_frames
from splatgraft.capture.virtual_cameras import (
    VirtualCameraOptions,
    VirtualCameras,
    place_virtual_cameras,
    render_pictures,
)

__all__ = [
    "PoseOptions",
    "PoseReport",
    "VirtualCameraOptions",
    "VirtualCameras",
    "extract_frames",
    "place_virtual_cameras",
    "pose_photos",
    "render_pictures",
    "upright",
]
