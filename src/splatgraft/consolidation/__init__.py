"""Consolidation: fits the colours of a composite to harmonised views (paper, Multi-View Consolidation)."""

from splatgraft.consolidation.color_fit import consolidate
from splatgraft.consolidation.options import ConsolidateOptions, ImageSequence

__all__ = [
    "ConsolidateOptions",
    "ImageSequence",
    "consolidate",
]
