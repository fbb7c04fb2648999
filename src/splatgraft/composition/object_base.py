"""Where an object touches the ground, and how large it is. Knows nothing about where it will stand."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.support_surface import support_below
from splatgraft.core.gaussians import Gaussians


@dataclass(frozen=True)
class ObjectBase:
    """How an object stands, in the frame of its own capture."""

    point: Float[Tensor, "3"]
    """Under the object's middle, at the level on which it stands."""
    up: Float[Tensor, "3"]
    """Unit; the normal of the surface on which it stood where that was found."""
    height: float
    """From the base to the top, world units."""
    radius: float
    """Horizontal reach from the middle, world units."""
    stands_on: str
    """What the base was taken from: "surface" (of its own capture) or "extent" (its lowest parts)."""


def object_base(object_: Gaussians, *, up: Float[Tensor, "3"], surroundings: Gaussians | None = None) -> ObjectBase:
    """Base of `object_`; `surroundings` is its own capture without it.

    Raises: ValueError where the object is empty.
    """
    if object_.count == 0:
        raise ValueError("placement: expected an object with Gaussians, found an empty one")
    up = torch.nn.functional.normalize(up.to(object_.means), dim=0)
    weight = object_.opacities * object_.log_scales.sort(dim=-1).values[:, 1:].sum(-1).exp()
    level = object_.means @ up
    reach = torch.einsum("i,nij,j->n", up, object_.covariances, up).clamp_min(0).sqrt()
    low, high = _quantile(level - reach, weight, 0.01), _quantile(level + reach, weight, 0.99)
    helper = torch.eye(3).to(up)[int(up.abs().argmin())]
    across = torch.nn.functional.normalize(torch.linalg.cross(up, helper), dim=0)
    along = torch.linalg.cross(up, across)
    middle = sum(
        0.5 * (_quantile(object_.means @ axis, weight, 0.02) + _quantile(object_.means @ axis, weight, 0.98)) * axis
        for axis in (across, along)
    )
    offset = object_.means - middle
    radius = float(_quantile((offset - (offset @ up)[:, None] * up).norm(dim=-1), weight, 0.97))
    base = ObjectBase(
        point=middle + low * up, up=up, height=float(high - low), radius=max(radius, 1e-9), stands_on="extent"
    )
    return base if surroundings is None else _on_own_surface(base, surroundings)


def _on_own_surface(base: ObjectBase, surroundings: Gaussians) -> ObjectBase:
    """The base on the surface that surrounds the object; the object's own extent where none is near its feet."""
    lowest = base.point + 0.3 * base.height * base.up
    try:
        # under the object nothing was seen: a disc twice as wide also sees the ring around it
        found = support_below(surroundings, lowest, up=base.up, radius=2 * base.radius, clearance=0.0)
    except ValueError:
        return base
    rise = float((found.point - base.point) @ base.up)
    # masks leave a little of the ground on the object, or a little of the object on the ground, but not half of it
    if abs(rise) > 0.25 * base.height or found.flat_fraction < 0.25:
        return base
    point = found.point
    return ObjectBase(point=point, up=found.normal, height=base.height - rise, radius=base.radius, stands_on="surface")


def _quantile(values: Float[Tensor, "n"], weight: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    order = values.argsort()
    filled = weight[order].double().cumsum(0)
    index = int(torch.searchsorted(filled, share * filled[-1]))
    return values[order[min(index, len(values) - 1)]]
