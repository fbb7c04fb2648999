"""Orientation of a capture: up becomes +z and the support plane z = 0, in any initial frame."""

import math

import pytest
import torch

from splatgraft.capture import upright
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.planes import dominant_level_plane
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity


def orbit(count=12):
    angle = torch.arange(count) * (2 * math.pi / count)
    eye = torch.stack([2 * angle.cos(), 2 * angle.sin(), 1 + 0.2 * (3 * angle).sin()], -1)
    return pinhole(look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1])), 200.0, width=160, height=120)


def floor_and_object():
    generator = torch.Generator().manual_seed(0)
    floor = torch.rand(600, 3, generator=generator) * 4 - 2
    floor[:, 2] = 0.002 * torch.randn(600, generator=generator)
    thing = 0.3 * torch.rand(300, 3, generator=generator) - torch.tensor([0.15, 0.15, 0.0])
    return torch.cat([floor, thing])


@pytest.fixture(params=[0, 1, 2])
def lost(request):
    """The frame that structure from motion happens to choose."""
    generator = torch.Generator().manual_seed(request.param)
    rotation = rotation_from_quaternion(torch.randn(1, 4, generator=generator))[0]
    return Similarity(scale=3.7, rotation=rotation, translation=torch.randn(3, generator=generator))


def test_floor_comes_to_z_zero_with_cameras_above(lost):
    upright_from_lost = upright(lost.cameras(orbit()), lost.points(floor_and_object()))
    cameras = upright_from_lost.cameras(lost.cameras(orbit()))
    points = upright_from_lost.points(lost.points(floor_and_object()))
    # 600 points with 2 mm of noise over 4 m fix a plane's tilt to far under a milliradian; distances here are about 2
    assert points[:600, 2].abs().max() < 0.005
    assert (cameras.centers[:, 2] > 0.2).all()
    assert (points[600:, 2] > -0.005).all()


def test_median_camera_distance_is_one(lost):
    cameras, points = lost.cameras(orbit()), lost.points(floor_and_object())
    moved = upright(cameras, points)
    middle = moved.points(points.median(0).values)  # a median by coordinate, so taken in the frame that upright saw
    distance = (moved.cameras(cameras).centers - middle).norm(dim=1).median()
    # float32 at distances of about ten
    assert torch.isclose(distance, torch.tensor(1.0), atol=1e-4)


def test_without_a_plane_the_cameras_say_what_is_up(lost):
    generator = torch.Generator().manual_seed(5)
    cloud = torch.randn(400, 3, generator=generator)
    turn = upright(lost.cameras(orbit()), lost.points(cloud))
    up = turn.rotation @ lost.rotation @ torch.tensor([0.0, 0, 1])
    # these cameras are exactly level, and estimate_up is exact then up to its prior
    assert float(up[2]) > math.cos(math.radians(1))


def test_a_wall_is_no_support():
    generator = torch.Generator().manual_seed(1)
    wall = torch.rand(500, 3, generator=generator)
    wall[:, 0] = 0
    assert dominant_level_plane(wall, torch.tensor([0.0, 0, 1])) is None


def test_few_points_make_no_plane():
    assert dominant_level_plane(torch.rand(10, 3), torch.tensor([0.0, 0, 1])) is None
