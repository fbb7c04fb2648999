"""A ball of Gaussians in front of a wall of Gaussians, seen by an arc of cameras."""

import math

import pytest
import torch
from shapes import blobs

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import concatenate
from splatgraft.rendering import render

BALL = 300


def splats(means, scale, opacity, rgb):
    return blobs(means, scale, srgb=rgb, opacity_logit=math.log(opacity / (1 - opacity)))


@pytest.fixture(scope="session")
def ball():
    generator = torch.Generator().manual_seed(0)
    means = 0.5 * torch.nn.functional.normalize(torch.randn(BALL, 3, generator=generator), dim=1)
    rgb = torch.tensor([0.9, 0.7, 0.1]) + 0.05 * torch.randn(BALL, 3, generator=generator)
    return splats(means, 0.06, 0.95, rgb)


@pytest.fixture(scope="session")
def wall():
    generator = torch.Generator().manual_seed(1)
    spots = torch.cartesian_prod(torch.linspace(-3, 3, 31), torch.linspace(-2, 2, 21))
    means = torch.stack([spots[:, 0], torch.full((len(spots),), 1.5), spots[:, 1]], -1)
    rgb = torch.tensor([0.4, 0.4, 0.45]) + 0.05 * torch.randn(len(spots), 3, generator=generator)
    return splats(means, 0.12, 0.95, rgb)


@pytest.fixture(scope="session")
def scene(ball, wall):
    """Return the whole scene; its first `BALL` Gaussians are the object."""
    return concatenate([ball, wall])


@pytest.fixture(scope="session")
def cameras():
    angle = torch.linspace(-0.6, 0.6, 6)
    eye = torch.stack([3 * angle.sin(), -3 * angle.cos(), 0.3 * (5 * angle).cos()], -1)
    poses = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1]))
    return pinhole(poses, 90.0, width=96, height=72)


@pytest.fixture(scope="session")
def masks(ball, cameras):
    return [(alpha > 0.5).float() for alpha in render(ball, cameras).alpha]


@pytest.fixture(scope="session")
def photographs(scene, cameras):
    return [image.clamp(0, 1) for image in render(scene, cameras).color]
