"""Lights as arrows: where they are drawn, and what dragging one means. Knows nothing about browsers."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting import Light, LightSource

_RING = 48


def arrow_points(source: LightSource, centre: Float[Tensor, "3"], reach: float) -> Float[Tensor, "2 3"]:
    """From where the light comes, `reach` away, to shortly before the object at `centre`."""
    direction = torch.tensor(source.direction)
    return torch.stack([centre + reach * direction, centre + 0.3 * reach * direction])


def ring_points(source: LightSource, centre: Float[Tensor, "3"], reach: float) -> Float[Tensor, "s 2 3"]:
    """A circle around the arrow's far end, as wide as the direction is uncertain, as line segments."""
    direction = torch.tensor(source.direction)
    helper = torch.eye(3)[int(direction.abs().argmin())]
    across = torch.nn.functional.normalize(torch.linalg.cross(direction, helper), dim=0)
    along = torch.linalg.cross(direction, across)
    radius = reach * math.tan(math.radians(min(60.0, max(0.5, source.uncertainty_deg))))
    angle = torch.linspace(0, 2 * math.pi, _RING + 1)
    points = centre + reach * direction + radius * (angle.cos()[:, None] * across + angle.sin()[:, None] * along)
    return torch.stack([points[:-1], points[1:]], 1)


def aimed(light: Light, index: int, towards: Float[Tensor, "3"]) -> Light:
    """The light with one source in another direction, which is certain now: a person said so."""
    length = float(towards.norm())
    if length < 1e-9:
        return light
    x, y, z = (towards / length).tolist()
    source = replace(light.sources[index], direction=(x, y, z), uncertainty_deg=0.0, confidence=1.0)
    return replace(light, sources=(*light.sources[:index], source, *light.sources[index + 1 :]))
