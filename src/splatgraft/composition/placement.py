"""Automatic placement of an object in a target scene: its base, a place, a scale, an upright pose and a yaw."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.facing_direction import facing_yaw_deg, unseen_share
from splatgraft.composition.object_base import ObjectBase, object_base
from splatgraft.composition.place_suggestion import Suggestion, scale_in_view, suggest_places
from splatgraft.composition.point_visibility import hidden_fraction
from splatgraft.composition.resting_pose import RestOptions, rest_on_surface
from splatgraft.composition.support_surface import Support, support_below
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity


@dataclass(frozen=True)
class PlaceOptions:
    """What the user decides; what is None is found."""

    point: tuple[float, float, float] | None = None
    """The object is placed on the surface below this point of the target; None finds a visible, level place."""
    scale: float | None = None
    """Size in the target over size in the source; None guesses from the views, as captures have no common unit."""
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
    warnings: tuple[str, ...] = field(default=())
    """Problems that a user should look at, one sentence each."""


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
        ValueError: The object is empty, or there is no surface at all.
    """
    target_cameras, source_cameras = cameras
    up = estimate_up(target_cameras)
    base = object_base(object_, up=estimate_up(source_cameras), surroundings=surroundings)
    found = _best_place(target, base, target_cameras, up, options)
    point, rest = found.point, RestOptions(scale=found.scale, yaw_deg=options.yaw_deg or 0.0, offset=options.offset)
    move, support = rest_on_surface(target, base, point=point, up=up, options=rest)
    if options.yaw_deg is None:
        yaw = facing_yaw_deg(
            _towards(source_cameras, base, move), target_cameras.centers - support.point, up=support.normal
        )
        move, support = rest_on_surface(target, base, point=point, up=up, options=replace(rest, yaw_deg=yaw))
    hidden = hidden_fraction(target, move.gaussians(object_), cameras=target_cameras)
    unseen = unseen_share(_towards(source_cameras, base, move), target_cameras.centers - support.point)
    return Placed(
        target_from_object=move,
        base=base,
        support=support,
        hidden_fraction=hidden,
        warnings=found.reasons + _warnings(support, hidden, unseen),
    )


def _towards(source_cameras: Cameras, base: ObjectBase, target_from_object: Similarity) -> Float[Tensor, "s 3"]:
    """From the object to the cameras of its own capture, in the target's frame, object units."""
    return (source_cameras.centers - base.point) @ target_from_object.rotation.T


_CLEARLY_BETTER = 1.5
"""By which factor a later place has to be better: an earlier one is nearer to where the cameras look. With 1.1 a second
object was put on top of the first."""


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


def _warnings(support: Support, hidden: float, unseen: float) -> tuple[str, ...]:
    out = []
    if unseen > 0.2:
        out.append(
            f"{unseen:.0%} of the target's images show a side of the object that none of its photos shows, where it is "
            "unknown: turn it (--yaw-deg), place it before a wall, or photograph it from there too."
        )
    # the underside is always hidden: a sixth of a cube
    if hidden > 0.25:
        out.append(f"{hidden:.0%} of the object is hidden from every camera: it may stick in a wall or in furniture.")
    if support.flat_fraction < 0.6:
        out.append(f"Only {support.flat_fraction:.0%} of the ground under the object is level.")
    if support.obstructed_fraction > 0.1:
        out.append(f"{support.obstructed_fraction:.0%} of the ground under the object is taken by something else.")
    return tuple(out)
