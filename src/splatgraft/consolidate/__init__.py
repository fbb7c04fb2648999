"""Consolidation of harmonised views into one scene. Knows nothing about files or harmonisers."""

from splatgraft.consolidate.consolidate import consolidate
from splatgraft.consolidate.nuisance import NuisanceOptions
from splatgraft.consolidate.options import ConsolidateOptions, DescentOptions, ImageSequence, LazyImages, SolveOptions
from splatgraft.consolidate.schedules import geometric_schedule, iterative_update, linear_schedule

__all__ = [
    "ConsolidateOptions",
    "DescentOptions",
    "ImageSequence",
    "LazyImages",
    "NuisanceOptions",
    "SolveOptions",
    "consolidate",
    "geometric_schedule",
    "iterative_update",
    "linear_schedule",
]
