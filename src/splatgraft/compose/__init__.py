"""Compose: objects are placed in a target scene. Knows nothing about light, images or files."""

from splatgraft.compose.assemble import compose
from splatgraft.compose.base import ObjectBase, object_base
from splatgraft.compose.checks import hidden_fraction
from splatgraft.compose.place import Placed, PlaceOptions, place_object
from splatgraft.compose.rest import RestOptions, rest_on_surface
from splatgraft.compose.suggest import Suggestion, suggest_place
from splatgraft.compose.support import Support, support_below
from splatgraft.composite import Composite, PlacedObject
from splatgraft.orbit import estimate_up

__all__ = [
    "Composite",
    "ObjectBase",
    "PlaceOptions",
    "Placed",
    "PlacedObject",
    "RestOptions",
    "Suggestion",
    "Support",
    "compose",
    "estimate_up",
    "hidden_fraction",
    "object_base",
    "place_object",
    "rest_on_surface",
    "suggest_place",
    "support_below",
]
