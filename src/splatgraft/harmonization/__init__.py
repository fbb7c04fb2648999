"""Harmonisation of rendered views: an image model corrects the light on an inserted object, one view at a time."""

from splatgraft.harmonization.harmonize import HarmonizedViews, harmonize, render_views
from splatgraft.harmonization.interface import Harmonized, Harmonizer, HarmonizerContext, HarmonizerInputs
from splatgraft.harmonization.methods import (
    HARMONIZERS,
    EditOptions,
    FluxOptions,
    HarmonizerOptions,
    NoneOptions,
    make_harmonizer,
)

__all__ = [
    "HARMONIZERS",
    "EditOptions",
    "FluxOptions",
    "Harmonized",
    "HarmonizedViews",
    "Harmonizer",
    "HarmonizerContext",
    "HarmonizerInputs",
    "HarmonizerOptions",
    "NoneOptions",
    "harmonize",
    "make_harmonizer",
    "render_views",
]
