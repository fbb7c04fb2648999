"""Consolidation of harmonised views into one scene. Knows nothing about files or harmonisers."""

from splatgraft.consolidation.consolidate import consolidate
from splatgraft.consolidation.options import (
    ConsolidateOptions,
    DescentOptions,
    ImageSequence,
    SolveOptions,
)
from splatgraft.consolidation.schedules import geometric_schedule, iterative_update, linear_schedule
from splatgraft.consolidation.view_errors import NuisanceOptions

__all__ = [
    "ConsolidateOptions",
    "DescentOptions",
    "ImageSequence",
    "NuisanceOptions",
    "SolveOptions",
    "consolidate",
    "geometric_schedule",
    "iterative_update",
    "linear_schedule",
]
