"""Consolidation: fit the colours of a composite to independently harmonised views (paper, Multi-View Consolidation)."""

from splatgraft.consolidation.consolidate import consolidate
from splatgraft.consolidation.options import (
    ConsolidateOptions,
    DescentOptions,
    ImageSequence,
    SolveOptions,
)
from splatgraft.consolidation.schedules import geometric_schedule, iterative_update, linear_schedule
from splatgraft.consolidation.view_errors import ViewErrorOptions

__all__ = [
    "ConsolidateOptions",
    "DescentOptions",
    "ImageSequence",
    "SolveOptions",
    "ViewErrorOptions",
    "consolidate",
    "geometric_schedule",
    "iterative_update",
    "linear_schedule",
]
