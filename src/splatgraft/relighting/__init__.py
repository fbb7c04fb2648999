"""Relight: what the new place's light does to an object, and the object to it. Knows nothing about files or views."""

from splatgraft.relighting.layers import LayerWeights, Relit
from splatgraft.relighting.light.light import Light, LightSource, light_from_json, light_to_json
from splatgraft.relighting.prepared_object import SourceScene
from splatgraft.relighting.shadow_removal import remove_object_shadow
from splatgraft.relighting.transfer import RelightOptions, relight

__all__ = [
    "LayerWeights",
    "Light",
    "LightSource",
    "RelightOptions",
    "Relit",
    "SourceScene",
    "light_from_json",
    "light_to_json",
    "relight",
    "remove_object_shadow",
]
