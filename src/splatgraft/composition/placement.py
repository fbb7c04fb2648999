"""Places objects in a target scene, by given transforms, or by a base, a place, a scale, an upright pose and a yaw."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.composition.coverage import Coverage
from splatgraft.composition.object_base import ObjectBase, object_base, rest_on_surface
from splatgraft.composition.places import Suggestion, hidden_fraction, scale_in_view, suggest_places
from splatgraft.composition.support_surface import Support, support_below
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.runtime.note import Note

# set by hand
_CLEARLY_BETTER = 1.5
"""By which factor a later place has to be better: an earlier one is nearer to where the cameras look."""
_YAW_SPREAD_DEG, _YAW_STEP_DEG = 30.0, 5
"""Standard deviation of the azimuth that a photograph covers around its own, and distance of the yaws tried."""
_GOOD_YAW = 0.98  # coverage over the best one above which the smallest turn is preferred


@dataclass(frozen=True)
class PlaceOptions:
    """What the user decides; what is None is found."""

    point: tuple[float, float, float] | None = None
    """Point of the target above the surface that carries the object. None: a visible, level place beside the captured
    thing, on its support."""
    scale: float | None = None
    """Size in the target over size in the source; None guesses from the views, as captures have no common unit, and
    takes no less than half of the guess."""
    yaw_deg: float | None = None
    """Rotation about up, counterclockwise seen from above; None turns photographed sides towards the cameras."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to the position, world units of the target."""


@dataclass(frozen=True)
class Placed:
    """Where an object was placed, and how well."""

    target_from_object: Similarity
    """The placement."""
    base: ObjectBase
    """The object's base, in its own capture."""
    support: Support
    """The surface under it."""
    hidden_fraction: float
    """Share of the object that no target camera can see, in [0, 1]."""
    coverage: Coverage
    """From where it was photographed, and from where the target's cameras look at it."""
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
        cameras: The target's cameras and the source's, in this order; from them follow the up directions, the size
            of the object in the picture and which sides of it were seen.
        surroundings: The source without the object, whose surface below the object gives the object's base.
        options: Point, scale and turn where they are not to be found.

    Returns:
        The placement, the surface that it rests on, and warnings.

    Raises:
        ValueError: The object is empty, or there is no surface at all; or no place is named, no scale is given, and
            nothing beside what the target's cameras look at has room for half of the guess (`NoFreePlaceError`, which
            has a picture).
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
    """From the object to the cameras of its own capture, in the target's frame, object units."""
    return (source_cameras.centers - base.point) @ target_from_object.rotation.T


def _best_place(
    target: Gaussians, base: ObjectBase, cameras: Cameras, up: Float[Tensor, "3"], options: PlaceOptions
) -> Suggestion:
    """The named point, or of the suggested places the one with most level and free ground that most views show."""
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
    # the underside is always hidden: a sixth of a cube
    if hidden > 0.25:
        text = f"{hidden:.0%} of the object is hidden from every camera: it may stick in a wall or in furniture."
        found.append(Note(text, "warning"))
    if support.flat_fraction < 0.6:
        text = f"The object stands on uneven ground: {support.flat_fraction:.0%} of what is under it is level."
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
    """Rotation about unit `up` that turns photographed sides towards the target's cameras, degrees in [-180, 180).

    Both directions are from the object, in the target's frame. Of about equally good ones the smallest: 0 where the
    capture goes all round.
    """
    yaw = torch.arange(-180, 180, _YAW_STEP_DEG, dtype=torch.float64)
    source, target = (_azimuth(x.double(), up.double()) for x in (to_source_cameras, to_target_cameras))
    miss = target[None, :, None] - source[None, None, :] - torch.deg2rad(yaw)[:, None, None]
    miss = torch.remainder(miss + math.pi, 2 * math.pi) - math.pi
    # for each camera of the target, how near in azimuth the nearest photograph was taken
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
        erased: Gaussians of the target that are left out; none where not given.

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
