"""Seed points by a plane sweep over views of a textured floor."""

import torch

from splatgraft.core import cameras as camera_values
from splatgraft.reconstruction.plane_sweep import NEAR, sweep

DISTANCE = 4.0


def texture(points: torch.Tensor) -> torch.Tensor:
    """Return smooth colours that differ everywhere within some units of the origin."""
    waves = torch.tensor([[2.1, 0.7], [-1.3, 1.9], [0.9, -2.3]])
    return 0.5 + 0.25 * (points @ waves.T).sin() + 0.2 * (1.7 * points @ waves.flip(0).T).cos()


def views_of_a_floor() -> tuple[list, list]:
    """Return ten views from a circle down to the plane z = 0, and their pictures by the ray through each pixel."""
    angle = torch.arange(10) * (2 * torch.pi / 10)
    eye = torch.stack([1.5 * angle.cos(), 1.5 * angle.sin(), torch.full_like(angle, DISTANCE)], 1)
    poses = camera_values.look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.1]))
    cameras = list(camera_values.pinhole(poses, 80.0, width=96, height=64))
    images = []
    for camera in cameras:
        y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(96) + 0.5, indexing="ij")
        rays = torch.stack([(x - 48) / 80, (y - 32) / 80, torch.ones_like(x)], -1)
        rays = rays @ camera.world_from_camera[0, :3, :3].T
        center = camera.centers[0]
        hit = center + rays * (-center[2] / rays[..., 2:])
        images.append(texture(hit[..., :2]))
    return cameras, images


def test_points_lie_on_the_surface_that_the_views_show():
    cameras, images = views_of_a_floor()
    found = sweep(cameras, images, known=torch.zeros(0, 3), reach=DISTANCE)
    assert len(found) > 500
    # 32 depths evenly spaced in inverse depth from 8 to 0.4 times the distance: the step at the floor is
    # d^2 (1 / 0.4 - 1 / 8) / (31 d) = 0.077 d = 0.31, and the nearest hypothesis is half of it off; of ties the farther
    # one is taken, which may be another step
    assert found.points[:, 2].abs().median() < 0.5
    truth = texture(found.points[:, :2])
    assert (found.colors - truth).abs().median() < 0.1


def test_plain_ground_between_known_points_is_found_at_their_plane():
    cameras, _ = views_of_a_floor()
    plain = [torch.full((64, 96, 3), 0.4) for _ in cameras]
    axis = torch.linspace(-4, 4, 6)
    known = torch.cat([torch.cartesian_prod(axis, axis), torch.zeros(36, 1)], 1)
    found = sweep(cameras, plain, known=known, reach=DISTANCE)
    # inverse depth is linear on a plane, so only float32 remains; without the known points, and beyond those in the
    # image, the farthest of all depths is taken
    on_floor = found.points[:, 2].abs() < 1e-3
    assert int(on_floor.sum()) > 0.5 * len(found) > 300


def test_known_points_on_one_line_of_an_image_give_no_depth_between_them():
    _, images = views_of_a_floor()
    # in the row through the centre of the first image, at depths 3 to 5
    x, z = torch.linspace(-1, 1, 8), torch.linspace(3, 5, 8)
    known = torch.stack([x * z, torch.zeros(8), z], 1)
    beside = torch.eye(4)
    beside[0, 3] = 0.5
    cameras = list(camera_values.pinhole(torch.stack([torch.eye(4), beside]), 80.0, width=96, height=64))
    found = sweep(cameras, images[:2], known=known, reach=DISTANCE)
    assert torch.isfinite(found.points).all()


def test_points_that_one_view_alone_shows_are_left_out():
    cameras, images = views_of_a_floor()
    images[0] = images[0].roll(24, dims=1)
    found = sweep(cameras, images, known=torch.zeros(0, 3), reach=DISTANCE)
    # within 5% of the floor's depth, plus the step between two hypotheses
    assert float((found.points[:, 2].abs() < 0.8).float().mean()) > 0.95


def test_rays_with_a_known_point_are_left_alone():
    cameras, images = views_of_a_floor()
    axis = torch.linspace(-8, 8, 200)
    floor = torch.cat([torch.cartesian_prod(axis, axis), torch.zeros(40_000, 1)], 1)
    # the floor's points are 0.08 apart, a cell of 6 pixels is 0.3 wide there
    assert len(sweep(cameras, images, known=floor, reach=DISTANCE)) == 0


def test_no_point_is_put_in_front_of_a_camera():
    cameras, _ = views_of_a_floor()
    flat = [torch.full((64, 96, 3), 0.4) for _ in cameras]
    found = sweep(cameras, flat, known=torch.zeros(0, 3), reach=DISTANCE)
    centers = torch.cat([camera.centers for camera in cameras])
    if len(found):
        assert torch.cdist(found.points, centers).min() > NEAR * DISTANCE
        # all depths of a blank wall match equally: the farthest in view is taken
        assert (found.points - centers.mean(0)).norm(dim=1).median() > 2 * DISTANCE


def test_views_from_one_place_give_no_points():
    cameras, images = views_of_a_floor()
    found = sweep(cameras[:1] * 5, images[:1] * 5, known=torch.zeros(0, 3), reach=DISTANCE)
    assert len(found) == 0
