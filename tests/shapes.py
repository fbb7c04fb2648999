"""Flat Gaussians on surfaces whose geometry is known, and cameras around them; for tests in closed form."""

import math

import torch
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.spherical_harmonics import dc_from_rgb

UP = torch.tensor([0.0, 0.0, 1.0])


def surfels(
    points: Tensor,
    normals: Tensor,
    *,
    width: float,
    srgb: Tensor | tuple[float, float, float] | float = 0.5,
    thickness: float | None = None,
) -> Gaussians:
    """Discs of standard deviation `width` at `points (n, 3)`; `srgb` is one gray, one colour or one per point."""
    n = len(points)
    thickness = 0.1 * width if thickness is None else thickness
    return Gaussians(
        means=points,
        log_scales=torch.tensor([width, width, thickness]).log().repeat(n, 1),
        quaternions=quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        opacity_logits=torch.full((n,), 3.0),
        sh=dc_from_rgb(torch.as_tensor(srgb).expand(n, 3))[:, None].clone(),
    )


def ring(
    count: int = 12,
    *,
    height: float = 1.5,
    radius: float = 2.5,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    focal: float = 100.0,
    size: tuple[int, int] = (128, 96),
) -> Cameras:
    """Cameras on a circle `height` above `center`, looking at it."""
    turn = torch.arange(count) / count * 2 * math.pi
    middle = torch.tensor(center)
    eyes = middle + torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full((count,), height)], 1)
    return pinhole(look_at(eyes, middle, UP), focal, width=size[0], height=size[1])


def random_scene(n: int, degree: int, seed: int) -> Gaussians:
    """Gaussians of a tenth of a unit within a few units of the origin."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(n, 3),
        log_scales=normal(n, 3) * 0.6 - 2.5,
        quaternions=normal(n, 4),
        opacity_logits=normal(n) * 1.5 + 0.5,
        sh=normal(n, (degree + 1) ** 2, 3) * 0.4,
    )


def camera_inside(width: int = 37, height: int = 29) -> Cameras:
    """A camera in `random_scene`, some Gaussians behind it; sizes that no tile divides."""
    pose = look_at(torch.tensor([[0.5, 0.3, -2.2]]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return pinhole(pose, 40.0, width=width, height=height)
