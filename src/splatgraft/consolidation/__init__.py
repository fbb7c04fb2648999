"""Consolidation: fit the colours of a composite to independently harmonised views (paper, Multi-View Consolidation)."""

from splatgraft.consolidation.consolidate import consolidate, geometric_schedule, iterative_update, linear_schedule
from splatgraft.consolidation.options import ConsolidateOptions, DescentOptions, ImageSequence, SolveOptions

__all__ = [
    "ConsolidateOptions",
    "DescentOptions",
    "ImageSequence",
    "SolveOptions",
    "consolidate",
    "geometric_schedule",
    "iterative_update",
    "linear_schedule",
]
