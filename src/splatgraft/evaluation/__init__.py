"""Evaluation of rendered views: metrics against ground truth, pictures, and the HTML report."""

from splatgraft.evaluation.geometry_pictures import depth_colors, normal_colors, normals_from_depth
from splatgraft.evaluation.measure import (
    ComparedView,
    Regions,
    Truth,
    compare,
    evaluate,
    find_regions,
    measure,
    true_views,
)
from splatgraft.evaluation.pictures import change_map, describe_change, side_by_side, write_animation
from splatgraft.evaluation.report import Report, ReportView, ReportWarning, StepTime, write_report
from splatgraft.evaluation.turntable import TurntableOptions, turntable_cameras

__all__ = [
    "ComparedView",
    "Regions",
    "Report",
    "ReportView",
    "ReportWarning",
    "StepTime",
    "Truth",
    "TurntableOptions",
    "change_map",
    "compare",
    "depth_colors",
    "describe_change",
    "evaluate",
    "find_regions",
    "measure",
    "normal_colors",
    "normals_from_depth",
    "side_by_side",
    "true_views",
    "turntable_cameras",
    "write_animation",
    "write_report",
]
