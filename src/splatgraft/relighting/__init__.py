"""Light transfer: an object gets the light of its new place, and the place gets the object's shadow and bounce."""

from splatgraft.relighting.layers import LayerWeights, Relit
from splatgraft.relighting.light.environment import EnvironmentLight, light_at
from splatgraft.relighting.light.light import Light, LightSource, light_from_json, light_to_json
from splatgraft.relighting.prepared_object import SourceScene
from splatgraft.relighting.transfer import RelightOptions, relight

__all__ = [
    "EnvironmentLight",
    "LayerWeights",
    "Light",
    "LightSource",
    "RelightOptions",
    "Relit",
    "SourceScene",
    "light_at",
    "light_from_json",
    "light_to_json",
    "relight",
]
