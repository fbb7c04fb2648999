"""Harmonization of rendered views: an image model corrects the light on an inserted object, one view at a time."""

from splatgraft.harmonization.harmonize import HarmonizedViews, harmonize
from splatgraft.harmonization.inputs import render_views
from splatgraft.harmonization.interface import (
    BatchHarmonizer,
    Harmonized,
    Harmonizer,
    HarmonizerInputs,
    NoisyStartHarmonizer,
)
from splatgraft.harmonization.methods import HARMONIZERS, harmonizer_options, make_harmonizer
from splatgraft.harmonization.options import (
    CompactOptions,
    FluxOptions,
    HarmonizerContext,
    HarmonizerOptions,
    NoneOptions,
)

__all__ = [
    "HARMONIZERS",
    "BatchHarmonizer",
    "CompactOptions",
    "FluxOptions",
    "Harmonized",
    "HarmonizedViews",
    "Harmonizer",
    "HarmonizerContext",
    "HarmonizerInputs",
    "HarmonizerOptions",
    "NoisyStartHarmonizer",
    "NoneOptions",
    "harmonize",
    "harmonizer_options",
    "make_harmonizer",
    "render_views",
]
