"""Places objects in a target scene, by given transforms or by an automatic placement.

The placement takes five steps:

1. The base of the object (`object_base`).
2. A free, level, visible place in the target, and a scale (`places`).
3. The pose that rests the base upright on the surface.
4. The yaw that turns photographed sides towards the target's cameras.
5. Warnings, for an object that is hidden, stands on uneven ground or cuts into something.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.composition.coverage import Coverage
from splatgraft.composition.object_base import ObjectBase, object_base, rest_on_surface
from splatgraft.composition.places import Suggestion, scale_in_view, suggest_places
from splatgraft.composition.support_surface import Support, support_below
from splatgraft.composition.visibility import hidden_fraction
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.runtime.note import Note

# set by hand
_CLEARLY_BETTER = 1.5  # factor by which a later suggestion must be better: an earlier one is nearer to the focus point
_YAW_SPREAD_DEG = 30.0  # standard deviation of the azimuths that a photograph covers around its own
_YAW_STEP_DEG = 5  # distance between the yaws tried
_GOOD_YAW = 0.98  # coverage over the best one above which the smallest turn is preferred


@dataclass(frozen=True)
class PlaceOptions:
    """User overrides; fields that are None are estimated."""

    point: tuple[float, float, float] | None = None
    """Point of the target above the surface that carries the object. None takes a visible, level place beside the
    captured thing, on its support."""
    scale: float | None = None
    """Size in the target over size in the source. None guesses it from the size in the views, because captures have no
    common unit, and takes no less than half of the guess."""
    yaw_deg: float | None = None
    """Rotation about up, counterclockwise seen from above; None turns photographed sides towards the cameras."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift added to the position, world units of the target."""


@dataclass(frozen=True)
class Placed:
    """The placement of an object, and measures of its quality."""

    target_from_object: Similarity
    """Similarity transform from the object's capture to the target."""
    base: ObjectBase
    """The object's base, in its own capture."""
    support: Support
    """The surface under the object."""
    hidden_fraction: float
    """Share of the object that no target camera can see, in [0, 1]."""
    coverage: Coverage
    """Directions of its photographs and of the target's views."""
    warnings: tuple[Note, ...] = ()
    """Problems that a user should look at."""


def place_object(
    target: Gaussians,
    object_: Gaussians,
    *,
    cameras: tuple[Cameras, Cameras],
    surroundings: Gaussians | None = None,
    options: PlaceOptions = PlaceOptions(),
) -> Placed:
    """Find a placement that rests an object upright on a surface of a target scene.

    Args:
        target: The scene that receives the object. For a further object: the composite so far, merged.
        object_: The object's Gaussians, in the frame of the capture that it comes from.
        cameras: The target's cameras and the source's, in this order. They give the up directions, the size of the
            object in the picture, and the sides of it that were photographed.
        surroundings: The source without the object; its surface below the object gives the object's base.
        options: Point, scale and turn, for those that should not be estimated.

    Returns:
        The placement, the surface that it rests on, and warnings.

    Raises:
        ValueError: The object is empty, or there is no surface at all.
        NoFreePlaceError: No point and no scale are given, and no place beside the captured thing has room for half of
            the guessed size; the error has a picture.
    """
    target_cameras, source_cameras = cameras
    up = estimate_up(target_cameras)
    base = object_base(object_, up=estimate_up(source_cameras), surroundings=surroundings)
    found = _best_place(target, base, target_cameras, up, options)
    place = partial(rest_on_surface, target, base, point=found.point, up=up, scale=found.scale)
    move, support = place(yaw_deg=options.yaw_deg or 0.0)
    if options.yaw_deg is None:
        yaw = facing_yaw_deg(
            _towards(source_cameras, base, move), target_cameras.centers - support.point, up=support.normal
        )
        move, support = place(yaw_deg=yaw)
    move = replace(move, translation=move.translation + torch.tensor(options.offset).to(move.translation))
    hidden = hidden_fraction(target, move.gaussians(object_), cameras=target_cameras)
    photographs, views = _towards(source_cameras, base, move), target_cameras.centers - support.point
    return Placed(
        target_from_object=move,
        base=base,
        support=support,
        hidden_fraction=hidden,
        coverage=Coverage.of(photographs, views, support.normal),
        warnings=found.notes + _warnings(support, hidden),
    )


def _towards(source_cameras: Cameras, base: ObjectBase, target_from_object: Similarity) -> Float[Tensor, "s 3"]:
    """Compute vectors from the object to the cameras of its own capture, in the target's axes, object units."""
    return (source_cameras.centers - base.point) @ target_from_object.rotation.T


def _best_place(
    target: Gaussians, base: ObjectBase, cameras: Cameras, up: Float[Tensor, "3"], options: PlaceOptions
) -> Suggestion:
    """Return the given point, or the suggested place that is best in level ground, free ground and visibility."""
    if options.point is not None:
        point = torch.tensor(options.point)
        scale = options.scale if options.scale is not None else scale_in_view(base, point, cameras=cameras)
        return Suggestion(point, scale, flat_fraction=1.0, visible_fraction=1.0)
    places = suggest_places(target, base, cameras=cameras, up=up, scale=options.scale)
    best, most = places[0], -1.0
    for place in places:
        try:
            support = support_below(target, place.point, up=up, radius=place.scale * base.radius)
        except ValueError:
            continue
        worth = support.flat_fraction * (1 - support.obstructed_fraction) * (0.1 + place.visible_fraction)
        if worth > _CLEARLY_BETTER * most:
            best, most = place, worth
    return best


def _warnings(support: Support, hidden: float) -> tuple[Note, ...]:
    found = []
    # the underside, a sixth of a cube, is always hidden
    if hidden > 0.25:
        text = f"{hidden:.0%} of the object is hidden from every camera: it may stick in a wall or in furniture."
        found.append(Note(text, "warning", "Move it (compose: point)"))
    if support.flat_fraction < 0.6:
        text = f"The object stands on uneven ground: {support.flat_fraction:.0%} of the ground under it is level."
        found.append(Note(text, "warning", "Move it (compose: point), or make it smaller (compose: scale)"))
    if support.obstructed_fraction > 0.1:
        text = f"The object cuts into something: {support.obstructed_fraction:.0%} of its place is taken."
        found.append(Note(text, "warning", "Move it (compose: point), or make it smaller (compose: scale)"))
    return tuple(found)


def facing_yaw_deg(
    to_source_cameras: Float[Tensor, "s 3"],
    to_target_cameras: Float[Tensor, "t 3"],
    *,
    up: Float[Tensor, "3"],
) -> float:
    """Compute the rotation about unit `up` that turns photographed sides towards the target's cameras.

    Both sets of directions start at the object, in the target's frame. The result is in degrees in [-180, 180). Among
    rotations of about the same coverage it is the smallest: 0 if the capture goes all round.
    """
    yaw = torch.arange(-180, 180, _YAW_STEP_DEG, dtype=torch.float64)
    source, target = (_azimuth(x.double(), up.double()) for x in (to_source_cameras, to_target_cameras))
    miss = target[None, :, None] - source[None, None, :] - torch.deg2rad(yaw)[:, None, None]
    miss = torch.remainder(miss + math.pi, 2 * math.pi) - math.pi
    # mean over the target's cameras of the nearness, in azimuth, of the nearest photograph
    covered = torch.exp(-0.5 * (miss / math.radians(_YAW_SPREAD_DEG)) ** 2).amax(2).mean(1)
    good = covered >= _GOOD_YAW * covered.max()
    return float(yaw[good][yaw[good].abs().argmin()])


def _azimuth(directions: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "n"]:
    tangent, bitangent = tangents(up)
    return torch.atan2(directions @ bitangent, directions @ tangent)


def compose(
    target: Gaussians,
    objects: Sequence[Gaussians],
    *,
    target_from_objects: Sequence[Similarity],
    erased: Bool[Tensor, "n"] | None = None,
) -> Composite:
    """Place objects in a target scene.

    Args:
        target: The scene that receives the objects, n Gaussians.
        objects: The objects, each in the frame of the capture that it comes from.
        target_from_objects: The placement of each object, such as `place_object` finds.
        erased: Whether each Gaussian of the target is left out; none by default.

    Returns:
        The composite; its parts are kept apart until it is baked.

    Raises:
        ValueError: There is not one transform per object, or `erased` has another length than the target.
    """
    if len(objects) != len(target_from_objects):
        raise ValueError(f"placement: expected {len(objects)} objects, one per .ply, found {len(target_from_objects)}")
    if erased is None:
        erased = torch.zeros(target.count, dtype=torch.bool, device=target.device)
    if len(erased) != target.count:
        raise ValueError(f"erased: expected one flag for each of {target.count} Gaussians, found {len(erased)}")
    pairs = zip(objects, target_from_objects, strict=True)
    placed = tuple(PlacedObject(gaussians=g, target_from_object=t) for g, t in pairs)
    return Composite(target=target, objects=placed, erased=erased)
