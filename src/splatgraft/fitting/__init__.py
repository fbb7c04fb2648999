"""Fitting chosen fields of Gaussians to images: the loop that reconstruct and consolidate share. Knows no files."""

from splatgraft.fitting.loop import Control, FitOptions, FitState, Loss, Pictures, Step, Views, fit, keep
from splatgraft.fitting.photometric import l1_dssim
from splatgraft.fitting.rates import Rates

__all__ = [
    "Control", "FitOptions", "FitState", "Loss", "Pictures", "Rates", "Step", "Views", "fit", "keep", "l1_dssim",
]  # fmt: skip
