"""An object is stood on a surface of the target. Knows nothing about how a good place is chosen."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.object_base import ObjectBase
from splatgraft.composition.support_surface import Support, support_below
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity


@dataclass(frozen=True)
class RestOptions:
    """How the object stands."""

    scale: float = 1.0
    """Size in the target over size in the object's own capture."""
    yaw_deg: float = 0.0
    """Turn about the surface's normal, counterclockwise seen from above."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to where it stands, world units of the target."""


def rest_on_surface(
    target: Gaussians,
    base: ObjectBase,
    *,
    point: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    options: RestOptions = RestOptions(),
) -> tuple[Similarity, Support]:
    """`target_from_object` that stands `base` upright on the surface below `point`, and that surface.

    Raises: ValueError where nothing level lies below `point`.
    """
    support = support_below(target, point, up=up, radius=options.scale * base.radius)
    rotation = _turn_about(support.normal, math.radians(options.yaw_deg)) @ _turn_onto(base.up, support.normal)
    place = support.point + torch.tensor(options.offset).to(support.point)
    translation = place - options.scale * rotation @ base.point
    return Similarity(scale=options.scale, rotation=rotation.float(), translation=translation.float()), support


def _turn_onto(start: Float[Tensor, "3"], end: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes unit `start` to unit `end`."""
    axis = torch.linalg.cross(start, end)
    sine, cosine = float(axis.norm()), float(start @ end)
    if sine < 1e-7:
        if cosine > 0:
            return torch.eye(3).to(start)
        helper = torch.eye(3).to(start)[int(start.abs().argmin())]
        axis = torch.nn.functional.normalize(torch.linalg.cross(start, helper), dim=0)
        return _turn_about(axis, math.pi)
    return _turn_about(axis / sine, math.atan2(sine, cosine))


def _turn_about(axis: Float[Tensor, "3"], angle: float) -> Float[Tensor, "3 3"]:
    x, y, z = axis.double().tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    turned = torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turned.to(axis)
