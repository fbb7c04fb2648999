"""An object's placement: its angles and size, and operations such as drop, rescale and duplicate."""

import math
import warnings
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from splatgraft.composition import NoFreePlaceError, ObjectBase, Placed, PlaceOptions, place_object, support_below
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_between
from splatgraft.core.similarity import Similarity

Triple = tuple[float, float, float]

_BESIDE = 2.2
"""Distance of a duplicate over the object's reach; the gap is a fifth of the reach."""
_INSIDE = 0.98
"""Share of an object's Gaussians within its reach; floaters do not count."""
_DIRECTIONS = 8
"""Number of directions in which a place for a duplicate is searched."""
_MIN_FLAT = 0.6
"""Smallest share of the object's base on the surface."""
_SAME_HEIGHT = 0.15
"""Largest height difference of places on one surface, over the object's height."""


def degrees_of(rotation: Float[Tensor, "3 3"]) -> Triple:
    """Return the angles of a rotation about the fixed x, then y, then z axis, in degrees."""
    with warnings.catch_warnings(action="ignore"):  # gimbal lock: any of the valid triples will do
        x, y, z = Rotation.from_matrix(rotation.double().numpy()).as_euler("xyz", degrees=True).tolist()
    return x, y, z


def rotation_of(degrees: Triple) -> Float[Tensor, "3 3"]:
    """Return the rotation about the fixed x, then y, then z axis, by angles in degrees."""
    return torch.from_numpy(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()).float()


@dataclass(frozen=True)
class ObjectSize:
    """The size of one placed object; what is None depends on an unknown scale of a capture."""

    scale: float
    """Size in the target over size in its own capture."""
    true_cm: float | None
    """Height in its own capture, cm; None also if the object was added from a file."""
    cm_per_scale: float | None
    """Height in the target, cm, at a `scale` of 1."""


@dataclass(frozen=True)
class PlaceableObject:
    """An object with its base and its capture."""

    gaussians: Gaussians
    """Gaussians in the frame of the object's capture."""
    base: ObjectBase
    """Lowest point, up and size, in the same frame."""
    cameras: Cameras
    """Cameras of the capture; those of the target if the object was added from a file."""
    surroundings: Gaussians | None
    """The capture without the object; None if unknown."""


def suggest_placement(
    target: Gaussians, item: PlaceableObject, cameras: Cameras, options: PlaceOptions = PlaceOptions()
) -> Placed:
    """Suggest a placement as `compose` does; if no place is free, place the object at half of the guessed size.

    Raise ValueError if there is no surface.
    """
    both = (cameras, item.cameras)
    place = partial(place_object, target, item.gaussians, cameras=both, surroundings=item.surroundings)
    try:
        return place(options=options)
    except NoFreePlaceError as error:
        return place(options=replace(options, scale=error.scale))


def drop_to_surface(
    target: Gaussians, item: PlaceableObject, target_from_object: Similarity, *, up: Float[Tensor, "3"]
) -> Similarity:
    """Move vertically onto the surface, and align with its normal by the smallest rotation.

    Raise ValueError if there is no surface below.
    """
    base, scale, rotation = item.base, target_from_object.scale, target_from_object.rotation
    up = torch.nn.functional.normalize(up, dim=0)
    # start at half the object's height: a sunk object is lifted, and surfaces above the object are ignored
    above = target_from_object.points(base.point) + 0.5 * scale * base.height * up
    support = support_below(target, above, up=up, radius=scale * base.radius)
    upright = rotation_between(rotation @ base.up, support.normal) @ rotation
    return with_base(item, replace(target_from_object, rotation=upright), at=support.point)


def rescale(item: PlaceableObject, target_from_object: Similarity, scale: float) -> Similarity:
    """Set the scale; the base point stays fixed."""
    return with_base(item, replace(target_from_object, scale=scale), at=target_from_object.points(item.base.point))


def with_base(item: PlaceableObject, target_from_object: Similarity, *, at: Float[Tensor, "3"]) -> Similarity:
    """Move the object so that its base point is at a point of the target."""
    offset = target_from_object.scale * target_from_object.rotation @ item.base.point
    return replace(target_from_object, translation=at - offset)


def place_beside(
    target: Gaussians, item: PlaceableObject, target_from_object: Similarity, *, up: Float[Tensor, "3"]
) -> tuple[Similarity, bool]:
    """Place a duplicate beside the object, on a surface of `target` at the same height.

    Also return whether there is such a surface; if not, the duplicate is in the air beside the object.
    """
    up = torch.nn.functional.normalize(up, dim=0)
    axis = torch.eye(3)[int(up.abs().argmin())]
    across = torch.nn.functional.normalize(axis - (axis @ up) * up, dim=0)
    along = torch.linalg.cross(up, across)
    size = target_from_object.scale * item.base.height
    step = _BESIDE * target_from_object.scale * _reach(item)
    old = float(target_from_object.points(item.base.point) @ up)
    for turn in range(_DIRECTIONS):
        angle = 2 * math.pi * turn / _DIRECTIONS
        shift = step * (math.cos(angle) * across + math.sin(angle) * along)
        shifted = _shifted(target_from_object, shift)
        above = shifted.points(item.base.point) + 0.5 * size * up
        try:
            support = support_below(target, above, up=up, radius=target_from_object.scale * item.base.radius)
        except ValueError:
            continue  # no surface below
        drop = float(support.point @ up) - old
        if abs(drop) <= _SAME_HEIGHT * size and support.flat_fraction >= _MIN_FLAT:
            # keep the rotation; adapt only the height
            return _shifted(shifted, drop * up), True
    return _shifted(target_from_object, step * across), False


def _reach(item: PlaceableObject) -> float:
    """Return an object's horizontal extent from its foot, in its own units."""
    offset = item.gaussians.means - item.base.point
    sideways = (offset - (offset @ item.base.up)[:, None] * item.base.up).norm(dim=1)
    return max(item.base.radius, float(sideways.quantile(_INSIDE)))


def _shifted(target_from_object: Similarity, shift: Float[Tensor, "3"]) -> Similarity:
    return replace(target_from_object, translation=target_from_object.translation + shift)
