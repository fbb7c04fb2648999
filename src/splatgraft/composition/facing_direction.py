"""Which sides of an object the target's cameras see, and the yaw that turns photographed ones towards them.

From camera directions alone.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents


@dataclass(frozen=True)
class FacingOptions:
    """How well a photograph covers nearby directions; values set by hand."""

    spread_deg: float = 30.0
    """Standard deviation of the azimuth around a photograph's."""
    step_deg: int = 5
    """Between the yaws tried."""
    good_share: float = 0.98
    """Coverage over the best one above which the smallest turn is preferred."""
    photographed_deg: float = 50.0
    """Largest angle to a photograph's direction from which a side of the object was seen well enough."""


def facing_yaw_deg(
    to_source_cameras: Float[Tensor, "s 3"],
    to_target_cameras: Float[Tensor, "t 3"],
    *,
    up: Float[Tensor, "3"],
    options: FacingOptions = FacingOptions(),
) -> float:
    """Rotation about `up` that turns photographed sides towards the target's cameras.

    Args:
        to_source_cameras: From the object to the cameras of its own capture, in the target's frame.
        to_target_cameras: From the object to the target's cameras, in the target's frame.
        up: Unit.
        options: What counts as covered by a photograph.

    Returns:
        Degrees in [-180, 180); the smallest of about equally good ones: 0 where the capture goes all round.
    """
    yaw = torch.arange(-180, 180, options.step_deg, dtype=torch.float64)
    source, target = (_azimuth(x.double(), up.double()) for x in (to_source_cameras, to_target_cameras))
    miss = target[None, :, None] - source[None, None, :] - torch.deg2rad(yaw)[:, None, None]
    miss = torch.remainder(miss + math.pi, 2 * math.pi) - math.pi
    # for each camera of the target, how near in azimuth the nearest photograph was taken
    covered = torch.exp(-0.5 * (miss / math.radians(options.spread_deg)) ** 2).amax(2).mean(1)
    good = covered >= options.good_share * covered.max()
    return float(yaw[good][yaw[good].abs().argmin()])


def unseen_share(
    to_source_cameras: Float[Tensor, "s 3"],
    to_target_cameras: Float[Tensor, "t 3"],
    *,
    options: FacingOptions = FacingOptions(),
) -> float:
    """Share of the target's cameras, in [0, 1], that see the object from where no photograph of it was taken.

    Args:
        to_source_cameras: From the object to the cameras of its own capture, in the target's frame.
        to_target_cameras: From the object to the target's cameras, in the target's frame.
        options: What counts as photographed.
    """
    source, target = (torch.nn.functional.normalize(x.double(), dim=1) for x in (to_source_cameras, to_target_cameras))
    nearest = (target @ source.T).amax(1)
    return float((nearest < math.cos(math.radians(options.photographed_deg))).double().mean())


def _azimuth(directions: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "n"]:
    tangent, bitangent = tangents(up)
    return torch.atan2(directions @ bitangent, directions @ tangent)
