"""Geometry of the arrows that show light sources in the 3D view, and the light after an arrow is dragged."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents
from splatgraft.relighting import Light, LightSource

_RING_SEGMENTS = 48


def arrow_points(source: LightSource, centre: Float[Tensor, "3"], length: float) -> Float[Tensor, "2 3"]:
    """Tail and head of the arrow of a source: from `length` away towards `centre`, ending at 0.3 `length`."""
    direction = torch.tensor(source.direction)
    return torch.stack([centre + length * direction, centre + 0.3 * length * direction])


def uncertainty_ring_points(source: LightSource, centre: Float[Tensor, "3"], length: float) -> Float[Tensor, "s 2 3"]:
    """Line segments of a circle around the arrow's tail; its angular radius is the uncertainty of the direction."""
    direction = torch.tensor(source.direction)
    across, along = tangents(direction)
    radius = length * math.tan(math.radians(min(60.0, max(0.5, source.uncertainty_deg))))
    angle = torch.linspace(0, 2 * math.pi, _RING_SEGMENTS + 1)
    points = centre + length * direction + radius * (angle.cos()[:, None] * across + angle.sin()[:, None] * along)
    return torch.stack([points[:-1], points[1:]], 1)


def with_direction(light: Light, index: int, towards: Float[Tensor, "3"]) -> Light:
    """The light with one source's direction set by hand, hence without uncertainty."""
    length = float(towards.norm())
    if length < 1e-9:
        return light
    x, y, z = (towards / length).tolist()
    source = replace(light.sources[index], direction=(x, y, z), uncertainty_deg=0.0, confidence=1.0)
    return replace(light, sources=(*light.sources[:index], source, *light.sources[index + 1 :]))
