"""Estimates the base of an object, and the pose in which the base rests on a surface of another scene.

The base comes from weighted quantiles of the object's Gaussians and, where it was seen, from the surface under them.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.support_surface import Support, support_below
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_about, rotation_between
from splatgraft.core.similarity import Similarity


@dataclass(frozen=True)
class ObjectBase:
    """Foot, up direction and size of an object, in the frame of its own capture."""

    point: Float[Tensor, "3"]
    """Point below the object's middle, at the level of the ground."""
    up: Float[Tensor, "3"]
    """Unit normal of the surface that it was captured on, or the up direction if no surface was found."""
    height: float
    """Height of the top above the base, world units."""
    radius: float
    """Horizontal reach from the middle, world units."""
    stands_on: str
    """Source of the base: "surface" (in its own capture) or "extent" (lowest parts of the object)."""


# set by hand; shares of the object's weight
_HEIGHT_TRIM = 0.01  # beyond the lowest and the highest level
_MIDDLE_TRIM = 0.02  # beyond either end of the horizontal extent, whose middle is taken
_WITHIN_RADIUS = 0.97
# lengths over the object's height or radius
_SEARCH_HEIGHT = 0.3  # start of the search for the ground, above the lowest part
_DISC_RADIUS = 2.0  # radius of the searched disc: the surroundings count, because the ground under it was not seen
_MAX_RISE = 0.1
"""Largest height of the ground above the lowest part. Masks rarely take more of the ground, and beside an object that
hangs on a wall the edges of other things look like ground."""
_MAX_GAP = 0.25  # largest depth of the ground below the lowest part: masks miss no more of a foot
_MIN_FLAT = 0.25  # smallest share of the disc that lies on the ground


def object_base(
    object_: Gaussians,
    *,
    up: Float[Tensor, "3"],
    surroundings: Gaussians | None = None,
) -> ObjectBase:
    """Estimate the base of `object_`: on its own ground if `surroundings` show that, otherwise at its lowest parts."""
    if object_.count == 0:
        raise ValueError("placement: expected an object with Gaussians, found an empty one")
    up = torch.nn.functional.normalize(up.to(object_.means), dim=0)
    weight = object_.opacities * object_.log_scales.sort(dim=-1).values[:, 1:].sum(-1).exp()
    level = object_.means @ up
    reach = torch.einsum("i,nij,j->n", up, object_.covariances, up).clamp_min(0).sqrt()
    low = _quantile(level - reach, weight, _HEIGHT_TRIM)
    high = _quantile(level + reach, weight, 1 - _HEIGHT_TRIM)
    ends = _MIDDLE_TRIM, 1 - _MIDDLE_TRIM
    middle = sum(
        0.5
        * (_quantile(object_.means @ axis, weight, ends[0]) + _quantile(object_.means @ axis, weight, ends[1]))
        * axis
        for axis in tangents(up)
    )
    offset = object_.means - middle
    radius = float(_quantile((offset - (offset @ up)[:, None] * up).norm(dim=-1), weight, _WITHIN_RADIUS))
    base = ObjectBase(
        point=middle + low * up, up=up, height=float(high - low), radius=max(radius, 1e-9), stands_on="extent"
    )
    return base if surroundings is None else _on_own_surface(base, surroundings)


def _on_own_surface(base: ObjectBase, surroundings: Gaussians) -> ObjectBase:
    """Move the base to the ground around the object, if there is ground near its lowest part."""
    start = base.point + _SEARCH_HEIGHT * base.height * base.up
    try:
        radius = _DISC_RADIUS * base.radius
        found = support_below(surroundings, start, up=base.up, radius=radius, clearance=0.0)
    except ValueError:
        return base
    rise = float((found.point - base.point) @ base.up)
    if not -_MAX_GAP * base.height <= rise <= _MAX_RISE * base.height or found.flat_fraction < _MIN_FLAT:
        return base
    point = found.point
    return ObjectBase(point=point, up=found.normal, height=base.height - rise, radius=base.radius, stands_on="surface")


def _quantile(values: Float[Tensor, "n"], weight: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """Compute the weighted quantile of `values` at `share`."""
    order = values.argsort()
    filled = weight[order].double().cumsum(0)
    index = int(torch.searchsorted(filled, share * filled[-1]))
    return values[order[min(index, len(values) - 1)]]


def rest_on_surface(
    target: Gaussians,
    base: ObjectBase,
    *,
    point: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    scale: float = 1.0,
    yaw_deg: float = 0.0,
) -> tuple[Similarity, Support]:
    """Compute the pose that rests an object on the surface below a point, upright along the surface's normal.

    Args:
        target: The scene with the surface.
        base: The object's base.
        point: Point above the surface, world units.
        up: The target's up direction.
        scale: Size in the target over size in the object's own capture.
        yaw_deg: Rotation about the surface's normal, counterclockwise seen from above.

    Returns:
        `target_from_object`, and the surface.

    Raises:
        ValueError: No surface lies below the point.
    """
    support = support_below(target, point, up=up, radius=scale * base.radius)
    yaw = rotation_about(support.normal, math.radians(yaw_deg))
    rotation = yaw @ rotation_between(base.up, support.normal)
    translation = support.point - scale * rotation @ base.point
    return Similarity(scale=scale, rotation=rotation.float(), translation=translation.float()), support
