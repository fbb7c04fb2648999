"""Turns a capture upright by its cameras and sparse points. Knows nothing about images or files."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.planes import dominant_level_plane
from splatgraft.core.similarity import Similarity


def upright(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Similarity:
    """upright_from_world: +z up, the support plane at z = 0 where one is clear, the median point above the origin.

    The median distance of the cameras from the median point becomes 1, since structure from motion knows no scale.
    """
    up = estimate_up(cameras)
    plane = dominant_level_plane(points, up)
    up = up if plane is None else plane.normal
    middle = points.median(0).values if len(points) else cameras.centers.mean(0)
    height = up @ middle if plane is None else plane.offset
    distance = (cameras.centers - middle).norm(dim=1).median()
    scale = float(1 / distance) if distance > 0 else 1.0
    rotation = _z_from(up)
    return Similarity(
        scale=scale, rotation=rotation, translation=-scale * (rotation @ (middle + up * (height - up @ middle)))
    )


def _z_from(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """A rotation that takes `up` to +z."""
    side = torch.eye(3).to(up)[int(up.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(side, up), dim=0)
    return torch.stack([x, torch.linalg.cross(up, x), up])
