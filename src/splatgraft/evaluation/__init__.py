"""Evaluation of rendered views: metrics against ground truth, pictures, and the HTML report."""

from splatgraft.evaluation.evaluate import evaluate, true_views
from splatgraft.evaluation.light_change import change_map, describe_change
from splatgraft.evaluation.measure import ComparedView, compare, measure
from splatgraft.evaluation.pictures import side_by_side, write_animation
from splatgraft.evaluation.regions import Regions, Truth, find_regions
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
    "describe_change",
    "evaluate",
    "find_regions",
    "measure",
    "side_by_side",
    "true_views",
    "turntable_cameras",
    "write_animation",
    "write_report",
]
