"""Fitting chosen fields of Gaussians to images by gradient descent, with image losses and a sparse Adam."""

from splatgraft.fitting.learning_rates import LearningRates
from splatgraft.fitting.loop import (
    Control,
    FitOptions,
    FitState,
    FixedViews,
    Loss,
    Step,
    View,
    Views,
    fit,
    leave_unchanged,
)
from splatgraft.fitting.photometric import l1_dssim

__all__ = [
    "Control",
    "FitOptions",
    "FitState",
    "FixedViews",
    "LearningRates",
    "Loss",
    "Step",
    "View",
    "Views",
    "fit",
    "l1_dssim",
    "leave_unchanged",
]  # fmt: skip
