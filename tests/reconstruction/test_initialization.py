"""Initial Gaussians from sparse points, and random points in the volume that cameras see."""

import torch

from splatgraft.core import cameras as camera_values
from splatgraft.reconstruction.initialization import SeedPoints, from_points, random_seeds, scene_extent


def orbit(count: int = 12, distance: float = 4.0) -> camera_values.Cameras:
    angle = torch.arange(count) * (2 * torch.pi / count)
    eye = distance * torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    poses = camera_values.look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return camera_values.pinhole(poses, 60.0, width=64, height=48)


def seeds_at(points: torch.Tensor, widest: float = torch.inf) -> SeedPoints:
    return SeedPoints(points, torch.rand(len(points), 3), torch.full((len(points),), widest))


def test_a_grid_of_points_gets_its_own_spacing():
    axis = 0.25 * torch.arange(5.0)
    points = torch.cartesian_prod(axis, axis, axis)
    start = from_points(seeds_at(points))
    # every point of a grid has three neighbours at one spacing; float32 rounding only
    assert torch.allclose(start.scales, torch.full((125, 3), 0.25), rtol=1e-5)
    assert torch.equal(start.means, points)


def test_points_beyond_the_budget_are_drawn_without_repetition_and_by_seed():
    seeds = seeds_at(torch.rand(500, 3))
    first, again, other = (seeds.drawn(100, seed) for seed in (1, 1, 2))
    assert len(first) == 100
    assert len(first.points.unique(dim=0)) == 100
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.points, other.points)
    assert torch.equal(seeds.drawn(1000, 0).points, seeds.points)


def test_no_gaussian_starts_wider_than_its_bound():
    start = from_points(seeds_at(torch.rand(50, 3), widest=1e-3))
    # float32 rounding only
    assert torch.allclose(start.scales, torch.full((50, 3), 1e-3), rtol=1e-5)


def test_a_stray_point_does_not_start_as_a_cloud():
    points = torch.cat([torch.rand(300, 3), torch.tensor([[1e4, 0.0, 0.0]])])
    start = from_points(seeds_at(points))
    # at most ten times the median spacing, by definition
    assert start.scales.max() < 11 * start.scales.median()


def test_one_point_and_equal_points_start_finite():
    for points in (torch.zeros(1, 3), torch.zeros(10, 3)):
        start = from_points(seeds_at(points))
        assert torch.isfinite(start.log_scales).all()


def test_random_points_lie_where_the_cameras_look():
    cameras = orbit()
    points = random_seeds(cameras, count=2000, seed=3).points
    assert len(points) == 2000
    assert torch.equal(points, random_seeds(cameras, count=2000, seed=3).points)
    # an orbit looks at the origin: the shared volume is centred on it; 2000 samples of a ball of radius 4 put the
    # mean within 4 / sqrt(2000) = 0.09 per axis, three times over
    assert points.mean(0).norm() < 0.5
    inside = torch.zeros(2000)
    for pose, intrinsics in zip(cameras.camera_from_world, cameras.intrinsics, strict=True):
        x = (points @ pose[:3, :3].T + pose[:3, 3]) @ intrinsics.T
        pixel = x[:, :2] / x[:, 2:]
        inside += (x[:, 2] > 0) & (pixel > 0).all(1) & (pixel < torch.tensor([64.0, 48.0])).all(1)
    assert (inside >= 1).all()


def test_parallel_cameras_still_have_a_volume():
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-1.0, 0.0, 1.0])
    cameras = camera_values.pinhole(poses, 60.0, width=64, height=48)
    points = random_seeds(cameras, count=100, seed=0).points
    assert torch.isfinite(points).all()
    assert (points[:, 2] > 0).all()


def test_extent_is_that_of_3dgs():
    # twelve cameras on a circle of radius 4 around their mean; float32 rounding only
    assert abs(scene_extent(orbit()) - 4.4) < 1e-5
    assert scene_extent(orbit()[:1]) == 1.0
