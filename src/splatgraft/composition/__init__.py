"""Composition: places objects in a target scene, by given transforms or on a surface that is found for them."""

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.composition.coverage import Coverage
from splatgraft.composition.object_base import ObjectBase, object_base, rest_on_surface
from splatgraft.composition.placement import Placed, PlaceOptions, compose, place_object
from splatgraft.composition.places import NoFreePlaceError, Suggestion, suggest_places
from splatgraft.composition.support_surface import Support, support_below
from splatgraft.composition.visibility import hidden_fraction
from splatgraft.core.capture_orientation import estimate_up

__all__ = [
    "Composite",
    "Coverage",
    "NoFreePlaceError",
    "ObjectBase",
    "PlaceOptions",
    "Placed",
    "PlacedObject",
    "Suggestion",
    "Support",
    "compose",
    "estimate_up",
    "hidden_fraction",
    "object_base",
    "place_object",
    "rest_on_surface",
    "suggest_places",
    "support_below",
]
