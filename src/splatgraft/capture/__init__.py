"""Capture: posed images from photos, a video, or a trained scene without images."""

from splatgraft.capture.clock_sun import geotag_notes, sun_by_clock, sun_heights
from splatgraft.capture.metric_scale import scale_from_length, scale_from_marker, triangulate
from splatgraft.capture.photos import write_reduced
from splatgraft.capture.pose_report import PoseReport, read_doubts, write_pose_report
from splatgraft.capture.structure_from_motion import PoseOptions, pose_photos, predict_pose_seconds
from splatgraft.capture.usable_views import (
    MIN_VIEWS,
    readable_views,
    require_coverage,
    usable_masks,
    usable_photos,
    usable_views,
)
from splatgraft.capture.video import VIDEO_FRAMES, describe_video, extract_frames
from splatgraft.capture.virtual_cameras import VirtualCameraOptions, place_virtual_cameras

__all__ = [
    "MIN_VIEWS",
    "VIDEO_FRAMES",
    "PoseOptions",
    "PoseReport",
    "VirtualCameraOptions",
    "describe_video",
    "extract_frames",
    "geotag_notes",
    "place_virtual_cameras",
    "pose_photos",
    "predict_pose_seconds",
    "read_doubts",
    "readable_views",
    "require_coverage",
    "scale_from_length",
    "scale_from_marker",
    "sun_by_clock",
    "sun_heights",
    "triangulate",
    "usable_masks",
    "usable_photos",
    "usable_views",
    "write_pose_report",
    "write_reduced",
]
