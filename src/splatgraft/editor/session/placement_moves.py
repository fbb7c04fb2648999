"""The moves a person asks for by name: drop, stand upright, a plausible size, a place. Knows nothing about browsers."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition import ObjectBase, PlaceOptions, RestOptions, object_base, place_object, rest_on_surface
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity


@dataclass(frozen=True)
class Placeable:
    """An object with what is known of how it stands."""

    gaussians: Gaussians
    """In the frame of its own capture."""
    base: ObjectBase
    """Its foot, in the same frame."""
    cameras: Cameras
    """Of its own capture; the target's where the object came as a file of its own."""
    surroundings: Gaussians | None
    """Its own capture without it, where known."""


def placeable(gaussians: Gaussians, cameras: Cameras, surroundings: Gaussians | None) -> Placeable:
    """The object with its foot found.

    Raises: ValueError where it is empty.
    """
    base = object_base(gaussians, up=estimate_up(cameras), surroundings=surroundings)
    return Placeable(gaussians, base, cameras, surroundings)


def suggested(
    target: Gaussians, item: Placeable, cameras: Cameras, options: PlaceOptions = PlaceOptions()
) -> Similarity:
    """A visible, level place at a plausible size, or what `options` say of it, as `compose` finds it.

    Raises: ValueError where there is none.
    """
    both = (cameras, item.cameras)
    placed = place_object(target, item.gaussians, cameras=both, surroundings=item.surroundings, options=options)
    return placed.target_from_object


def dropped(target: Gaussians, item: Placeable, move: Similarity, *, up: Float[Tensor, "3"]) -> Similarity:
    """Straight down (or up, where it is sunk) onto the surface, upright; its size and its turn about the vertical stay.

    Raises: ValueError where nothing level lies below.
    """
    foot = move.points(item.base.point)
    # from half the object's height: a sunk object comes up again, and what hangs above it is not seen
    above = foot + 0.5 * move.scale * item.base.height * torch.nn.functional.normalize(up, dim=0)
    straight, support = rest_on_surface(target, item.base, point=above, up=up, options=RestOptions(scale=move.scale))
    turn = _turn_about(move.rotation @ straight.rotation.T, support.normal)
    options = RestOptions(scale=move.scale, yaw_deg=math.degrees(turn))
    return rest_on_surface(target, item.base, point=above, up=up, options=options)[0]


def upright(item: Placeable, move: Similarity, *, up: Float[Tensor, "3"]) -> Similarity:
    """Turned by the least angle so that the object's own up is the target's; its foot stays where it is."""
    up = torch.nn.functional.normalize(up, dim=0)
    rotation = _least_turn(move.rotation @ item.base.up, up) @ move.rotation
    return _about_foot(item, move, rotation=rotation, scale=move.scale)


def resized(item: Placeable, move: Similarity, scale: float) -> Similarity:
    """At another size; its foot stays where it is."""
    return _about_foot(item, move, rotation=move.rotation, scale=scale)


def plausible_scale(target: Gaussians, item: Placeable, move: Similarity, cameras: Cameras) -> float:
    """The size that fills the usual share of the views at the object's place.

    Raises: ValueError where nothing level lies below.
    """
    x, y, z = (move.points(item.base.point) + 0.25 * move.scale * item.base.height * estimate_up(cameras)).tolist()
    options = PlaceOptions(point=(x, y, z), yaw_deg=0.0)
    return place_object(
        target, item.gaussians, cameras=(cameras, item.cameras), surroundings=item.surroundings, options=options
    ).target_from_object.scale


def beside(item: Placeable, move: Similarity, *, up: Float[Tensor, "3"]) -> Similarity:
    """The same again, one and a half widths to the side."""
    up = torch.nn.functional.normalize(up, dim=0)
    axis = torch.eye(3)[int(up.abs().argmin())]
    across = torch.nn.functional.normalize(axis - (axis @ up) * up, dim=0)
    step = 3.0 * move.scale * item.base.radius * across
    return Similarity(scale=move.scale, rotation=move.rotation, translation=move.translation + step)


def _about_foot(item: Placeable, move: Similarity, *, rotation: Float[Tensor, "3 3"], scale: float) -> Similarity:
    foot = move.points(item.base.point)
    return Similarity(scale=scale, rotation=rotation, translation=foot - scale * rotation @ item.base.point)


def _turn_about(rotation: Float[Tensor, "3 3"], axis: Float[Tensor, "3"]) -> float:
    """How far `rotation` turns about unit `axis`, radians: the twist that is left when its swing is taken off."""
    skew = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    trace = rotation.diagonal().sum()
    # with q = (1 + trace, skew) up to a factor, the twist's half angle has this tangent
    return 2 * math.atan2(float(skew @ axis), 1 + float(trace))


def _least_turn(start: Float[Tensor, "3"], end: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    axis = torch.linalg.cross(start, end)
    sine, cosine = float(axis.norm()), float(start @ end)
    if sine < 1e-6:
        if cosine > 0:
            return torch.eye(3)
        helper = torch.eye(3)[int(start.abs().argmin())]
        axis, sine = torch.linalg.cross(start, helper), 0.0
    unit = torch.nn.functional.normalize(axis, dim=0).double()
    return torch.linalg.matrix_exp(math.atan2(sine, cosine) * _cross_matrix(unit)).float()


def _cross_matrix(axis: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    x, y, z = axis.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
