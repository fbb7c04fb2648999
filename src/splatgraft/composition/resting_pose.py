"""Pose of an object that rests upright on the surface below a point of the target."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.object_base import ObjectBase
from splatgraft.composition.support_surface import Support, support_below
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_about, rotation_between
from splatgraft.core.similarity import Similarity


@dataclass(frozen=True)
class RestOptions:
    """Scale, yaw and offset of the resting object."""

    scale: float = 1.0
    """Size in the target over size in the object's own capture."""
    yaw_deg: float = 0.0
    """Rotation about the surface's normal, counterclockwise seen from above."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to the position, world units of the target."""


def rest_on_surface(
    target: Gaussians,
    base: ObjectBase,
    *,
    point: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    options: RestOptions = RestOptions(),
) -> tuple[Similarity, Support]:
    """`target_from_object` that rests `base` on the surface below `point`, along its normal, and that surface.

    Args:
        target: The receiving scene.
        base: The object's base, in its own capture.
        point: On or above the surface, in the target.
        up: Of the target, of any length but zero.
        options: Scale, yaw and offset.

    Raises:
        ValueError: Where no surface lies below `point`.
    """
    support = support_below(target, point, up=up, radius=options.scale * base.radius)
    yaw = rotation_about(support.normal, math.radians(options.yaw_deg))
    rotation = yaw @ rotation_between(base.up, support.normal)
    place = support.point + torch.tensor(options.offset).to(support.point)
    translation = place - options.scale * rotation @ base.point
    return Similarity(scale=options.scale, rotation=rotation.float(), translation=translation.float()), support
