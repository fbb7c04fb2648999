"""Relight: what the new place's light does to an object, and the object to it. Knows nothing about files or views."""

from splatgraft.relight.body import SourceScene
from splatgraft.relight.cache import RelightCache
from splatgraft.relight.layers import LayerWeights, Relit
from splatgraft.relight.light import Light, LightSource, light_from_json, light_to_json
from splatgraft.relight.old_place import without_shadow
from splatgraft.relight.transfer import RelightOptions, relight

__all__ = [
    "LayerWeights",
    "Light",
    "LightSource",
    "RelightCache",
    "RelightOptions",
    "Relit",
    "SourceScene",
    "light_from_json",
    "light_to_json",
    "relight",
    "without_shadow",
]
