"""Up direction and focus point of a capture, from its camera poses alone, by reweighted least squares."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras

_ROUNDS = 10
"""Rounds of reweighting; this and the others are set by hand."""
_ROLL_RAD = 0.05
"""Roll above which a camera counts less: hand-held cameras are level to about three degrees."""
_MEAN_UP_WEIGHT = 0.01
"""Weight of the images' mean up, equal to that of horizontal axes that spread over 6 degrees."""
_RESIDUAL_FLOOR = 0.1
"""Distance of an axis from the focus point, over the median one, below which weights stop growing."""
_MIN_IN_FRONT = 0.7
"""Share of the cameras that have the focus point in front of them."""


def estimate_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Unit up direction of the world, perpendicular to the images' horizontal axes, as most cameras are not rolled.

    The images' mean up decides the sign, and the direction where all cameras face one way. Rolled cameras are
    outliers of an iteratively reweighted least-squares fit.
    """
    right = cameras.world_from_camera[:, :3, 0].double()
    mean_up = torch.nn.functional.normalize(-cameras.world_from_camera[:, :3, 1].double().mean(0), dim=0)
    up = mean_up
    for _ in range(_ROUNDS):
        weight = _ROLL_RAD / (_ROLL_RAD + (right @ up).abs())
        spread = (right * weight[:, None]).T @ right / weight.sum()
        prior = _MEAN_UP_WEIGHT * torch.eye(3, dtype=torch.float64)
        up = torch.nn.functional.normalize(torch.linalg.solve(spread + prior, _MEAN_UP_WEIGHT * mean_up), dim=0)
    return up.to(cameras.world_from_camera)


def focus_point(cameras: Cameras) -> Float[Tensor, "3"]:
    """The point nearest to all optical axes, in world units, by iteratively reweighted least squares.

    Raises:
        ValueError: Where it lies behind many cameras, as in a capture that looks outwards.
    """
    centers, forward = cameras.centers.double(), cameras.world_from_camera[:, :3, 2].double()
    weight = torch.ones(len(cameras), dtype=torch.float64)
    point = centers.mean(0)
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    for _ in range(_ROUNDS):
        normal = (weight[:, None, None] * across).sum(0)
        wanted = torch.einsum("v,vij,vj->i", weight, across, centers)
        point = torch.linalg.lstsq(normal + 1e-9 * torch.eye(3, dtype=torch.float64), wanted[:, None]).solution[:, 0]
        miss = torch.einsum("vij,vj->vi", across, point - centers).norm(dim=-1)
        weight = 1 / (miss + _RESIDUAL_FLOOR * miss.median() + 1e-9)
    in_front = float((((point - centers) * forward).sum(-1) > 0).double().mean())
    if in_front < _MIN_IN_FRONT:
        raise ValueError(
            f"cameras: expected some that look at one place, found one in front of only {in_front:.0%} of them;"
            " name the place"
        )
    return point.to(cameras.world_from_camera)
