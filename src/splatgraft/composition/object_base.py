"""Base point, up axis, height and radius of an object, from weighted quantiles and the surface it was captured on."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.support_surface import support_below
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians


@dataclass(frozen=True)
class ObjectBase:
    """Where an object touches the ground and how large it is, in the frame of its own capture."""

    point: Float[Tensor, "3"]
    """Below the object's middle, at the level of the ground."""
    up: Float[Tensor, "3"]
    """Unit; the normal of the surface it was captured on where that was found."""
    height: float
    """From the base to the top, world units."""
    radius: float
    """Horizontal reach from the middle, world units."""
    stands_on: str
    """Source of the base: "surface" (of its own capture) or "extent" (lowest parts of the object)."""


@dataclass(frozen=True)
class ObjectBaseOptions:
    """Quantiles of the object's extent, and when its own ground is used; values set by hand."""

    height_trim: float = 0.01
    """Share of the object's weight beyond its lowest and its highest level."""
    middle_trim: float = 0.02
    """Share of the object's weight beyond either end of its horizontal extent, whose middle is taken."""
    reach: float = 0.97
    """Share of the object's weight within its radius."""
    search_height: float = 0.3
    """Height above the lowest part from which the ground is searched downwards, over the object's height."""
    disc_radius: float = 2.0
    """Radius of the searched disc over the object's: nothing was seen under the object, so its surroundings count."""
    most_rise: float = 0.1
    """Largest height of the ground above the lowest part, over the object's: masks that take more of the ground are
    rare, and what hangs on a wall has edges of other things beside it that look like ground."""
    most_gap: float = 0.25
    """Largest depth of the ground below the lowest part, over the height: masks do not miss more of a foot."""
    least_flat: float = 0.25
    """Least share of the disc that lies on the ground."""


def object_base(
    object_: Gaussians,
    *,
    up: Float[Tensor, "3"],
    surroundings: Gaussians | None = None,
    options: ObjectBaseOptions = ObjectBaseOptions(),
) -> ObjectBase:
    """Base of `object_`, on its own ground where that is found, otherwise at its lowest parts.

    Args:
        object_: The object in the frame of its capture.
        up: Of any length but zero.
        surroundings: The capture without the object; None where there is none.
        options: Quantiles and tolerances.

    Raises:
        ValueError: Where the object is empty.
    """
    if object_.count == 0:
        raise ValueError("placement: expected an object with Gaussians, found an empty one")
    up = torch.nn.functional.normalize(up.to(object_.means), dim=0)
    weight = object_.opacities * object_.log_scales.sort(dim=-1).values[:, 1:].sum(-1).exp()
    level = object_.means @ up
    reach = torch.einsum("i,nij,j->n", up, object_.covariances, up).clamp_min(0).sqrt()
    low = _quantile(level - reach, weight, options.height_trim)
    high = _quantile(level + reach, weight, 1 - options.height_trim)
    ends = options.middle_trim, 1 - options.middle_trim
    middle = sum(
        0.5
        * (_quantile(object_.means @ axis, weight, ends[0]) + _quantile(object_.means @ axis, weight, ends[1]))
        * axis
        for axis in tangents(up)
    )
    offset = object_.means - middle
    radius = float(_quantile((offset - (offset @ up)[:, None] * up).norm(dim=-1), weight, options.reach))
    base = ObjectBase(
        point=middle + low * up, up=up, height=float(high - low), radius=max(radius, 1e-9), stands_on="extent"
    )
    return base if surroundings is None else _on_own_surface(base, surroundings, options)


def _on_own_surface(base: ObjectBase, surroundings: Gaussians, options: ObjectBaseOptions) -> ObjectBase:
    """The base moved to the ground around the object; unchanged where there is none near its lowest part."""
    start = base.point + options.search_height * base.height * base.up
    try:
        radius = options.disc_radius * base.radius
        found = support_below(surroundings, start, up=base.up, radius=radius, clearance=0.0)
    except ValueError:
        return base
    rise = float((found.point - base.point) @ base.up)
    if (
        not -options.most_gap * base.height <= rise <= options.most_rise * base.height
        or found.flat_fraction < options.least_flat
    ):
        return base
    point = found.point
    return ObjectBase(point=point, up=found.normal, height=base.height - rise, radius=base.radius, stands_on="surface")


def _quantile(values: Float[Tensor, "n"], weight: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """Weighted quantile."""
    order = values.argsort()
    filled = weight[order].double().cumsum(0)
    index = int(torch.searchsorted(filled, share * filled[-1]))
    return values[order[min(index, len(values) - 1)]]
