"""Which side of an object should face the target's cameras: the one that was photographed. Looks at no Gaussian."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_SPREAD = math.radians(30)
_STEP_DEG = 5


def facing_yaw_deg(
    seen_from: Float[Tensor, "s 3"], looked_at_from: Float[Tensor, "t 3"], *, up: Float[Tensor, "3"]
) -> float:
    """Turn about `up` that brings photographed sides before the cameras, in degrees within [-180, 180).

    `seen_from` are directions from the object to the cameras of its capture, `looked_at_from` to those of the target,
    both in the target's frame. Of equally good turns it is the smallest: 0 where the capture went all round.
    """
    yaw = torch.arange(-180, 180, _STEP_DEG, dtype=torch.float64)
    source, target = (_azimuth(x.double(), up.double()) for x in (seen_from, looked_at_from))
    miss = target[None, :, None] - source[None, None, :] - torch.deg2rad(yaw)[:, None, None]
    miss = torch.remainder(miss + math.pi, 2 * math.pi) - math.pi
    # for each camera of the target, how near the nearest photograph was taken
    covered = torch.exp(-0.5 * (miss / _SPREAD) ** 2).amax(2).mean(1)
    good = covered >= 0.98 * covered.max()
    return float(yaw[good][yaw[good].abs().argmin()])


def _azimuth(directions: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "n"]:
    helper = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    across = torch.nn.functional.normalize(torch.linalg.cross(up, helper), dim=0)
    return torch.atan2(directions @ torch.linalg.cross(up, across), directions @ across)
