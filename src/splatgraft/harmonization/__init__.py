"""Harmonisation of rendered views: an image model corrects the light on an inserted object, one view at a time."""

from splatgraft.harmonization.harmonize import harmonize, render_views
from splatgraft.harmonization.interface import Harmonizer, HarmonizerContext, HarmonizerInputs
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
    "Harmonizer",
    "HarmonizerContext",
    "HarmonizerInputs",
    "HarmonizerOptions",
    "NoneOptions",
    "harmonize",
    "make_harmonizer",
    "render_views",
]
