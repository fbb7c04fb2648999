"""Errors of benchmarks/geometry.py on a plane of known depth and normal, and the points that it finds."""

import geometry
import pytest
import torch
from bare_tables import has_texture

from splatgraft.core.cameras import Cameras, look_at, pinhole


@pytest.fixture
def camera() -> Cameras:
    """Return a camera that looks down at the ground, z = 0, half a radian below the horizon."""
    eye = torch.tensor([[0.0, -1.76, 0.96]])
    return pinhole(look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), 120.0, width=96, height=64)


def ground_depth(camera: Cameras, slope: float = 0.0):
    """Return the depth of the plane z = slope * y, stored as float16 like the renders."""
    pose = camera.world_from_camera[0]
    normal = torch.tensor([0.0, -slope, 1.0])
    depth = -(pose[:3, 3] @ normal) / (camera.rays() @ pose[:3, :3].T @ normal)
    return depth.half().float()


def test_depth_is_off_by_its_share_of_the_true_one_and_wholly_where_nothing_is_seen(camera):
    truth = ground_depth(camera)
    nothing = geometry.depth_error(torch.zeros_like(truth), truth)
    # a product of float32 numbers
    torch.testing.assert_close(
        geometry.depth_error(1.04 * truth, truth), torch.full_like(truth, 0.04), atol=1e-6, rtol=0
    )
    assert (nothing == 1).all()


def test_normals_of_a_plane_are_its_own(camera):
    rotation = camera.world_from_camera[0, :3, :3]
    normals = geometry.normals_of_depth(ground_depth(camera), camera)[4:-4, 4:-4] @ rotation.T
    angle = normals[..., 2].clamp(-1, 1).arccos().rad2deg()
    # float16 rounds by a share of 2^-11 or less, of deviation 2.8e-4; the averages of 25 pixels, 2 of 1/120
    # apart, share 15: 2.8e-4 * sqrt(20) / 25 * 120 / 2 tilts a surface seen from the front by 0.17 degrees on either
    # axis, whose joint median is 0.2, and a slanted one by less
    assert float(angle.median()) < 0.2


def test_the_error_of_normals_is_the_angle_between_two_planes(camera):
    truth = ground_depth(camera)
    tilted = ground_depth(camera, slope=0.2)
    tilted[:8] = 0
    error = geometry.normal_error_deg(tilted, truth, camera)
    assert (error[3:8, 3:-3] == 90).all()
    # the border has no normal
    assert error[:3].isnan().all()
    # each of the two is off by 0.2 degrees or less in the median, see above
    assert float(error[12:-3, 3:-3].median()) == pytest.approx(11.31, abs=0.4)


def test_points_are_found_on_corners_and_not_along_an_edge():
    picture = torch.zeros(40, 60, 3)
    picture[:, 30:] = 1
    picture[10:14, 10:14] = 1
    found = has_texture(picture)
    assert found[10:14, 10:14].all()
    assert not found[:, 20:].any()
