"""Capture: posed images from photos, from a video, or from a trained scene that comes without images."""

from splatgraft.capture.duration import predict_pose_seconds
from splatgraft.capture.metric_scale import FoundScale, scale_from_length, scale_from_marker, triangulate
from splatgraft.capture.odd_photos import drawn_pictures
from splatgraft.capture.orientation import upright
from splatgraft.capture.photos import write_reduced
from splatgraft.capture.plausibility import Doubt, Found, Lens, Plausible, find_doubts
from splatgraft.capture.pose_report import POSE_REPORT_FILE, PoseReport, Unposed, read_pose_report, write_pose_report
from splatgraft.capture.scene_fit import misfit_of
from splatgraft.capture.structure_from_motion import PoseOptions, pose_photos
from splatgraft.capture.usable_views import readable_views, usable_masks, usable_photos, usable_views
from splatgraft.capture.video import VIDEO_FRAMES, VideoFacts, extract_frames, read_video_facts
from splatgraft.capture.view_coverage import CoverageRule, median_parallax_deg, require_coverage
from splatgraft.capture.virtual_cameras import (
    VirtualCameraOptions,
    VirtualCameras,
    place_virtual_cameras,
    render_pictures,
)

__all__ = [
    "POSE_REPORT_FILE",
    "VIDEO_FRAMES",
    "CoverageRule",
    "Doubt",
    "Found",
    "FoundScale",
    "Lens",
    "Plausible",
    "PoseOptions",
    "PoseReport",
    "Unposed",
    "VideoFacts",
    "VirtualCameraOptions",
    "VirtualCameras",
    "drawn_pictures",
    "extract_frames",
    "find_doubts",
    "median_parallax_deg",
    "misfit_of",
    "place_virtual_cameras",
    "pose_photos",
    "predict_pose_seconds",
    "read_pose_report",
    "read_video_facts",
    "readable_views",
    "render_pictures",
    "require_coverage",
    "scale_from_length",
    "scale_from_marker",
    "triangulate",
    "upright",
    "usable_masks",
    "usable_photos",
    "usable_views",
    "write_pose_report",
    "write_reduced",
]
