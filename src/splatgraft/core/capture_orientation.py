"""Which way is up and what the photographer looked at, from cameras alone. Knows nothing about what is in the scene."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras

_ROUNDS = 10


def estimate_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Unit up of the world: photographers seldom roll, so it is at right angles to every image's horizontal axis.

    The mean of the images' own up decides the sign, and the direction where all cameras face one way. A few rolled
    photos are outvoted (iteratively reweighted least squares).
    """
    right = cameras.world_from_camera[:, :3, 0].double()
    mean_up = torch.nn.functional.normalize(-cameras.world_from_camera[:, :3, 1].double().mean(0), dim=0)
    up = mean_up
    for _ in range(_ROUNDS):
        # 0.05 rad: a hand holds a camera level to about three degrees
        weight = 0.05 / (0.05 + (right @ up).abs())
        spread = (right * weight[:, None]).T @ right / weight.sum()
        # 0.01: the mean up counts as much as horizontals that spread over 6 degrees
        prior = 0.01 * torch.eye(3, dtype=torch.float64)
        up = torch.nn.functional.normalize(torch.linalg.solve(spread + prior, 0.01 * mean_up), dim=0)
    return up.to(cameras.world_from_camera)


def focus_point(cameras: Cameras) -> Float[Tensor, "3"]:
    """The point that lies nearest to all optical axes, in world units.

    Raises: ValueError where the axes do not meet in front of most cameras, as in a capture that looks around.
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
        weight = 1 / (miss + 0.1 * miss.median() + 1e-9)
    in_front = float((((point - centers) * forward).sum(-1) > 0).double().mean())
    if in_front < 0.7:
        raise ValueError(
            f"cameras: expected some that look at one place, found one in front of only {in_front:.0%} of them;"
            " name the place"
        )
    return point.to(cameras.world_from_camera)
