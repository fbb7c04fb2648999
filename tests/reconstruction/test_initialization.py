"""Initial Gaussians: from sparse points, at random in the cameras' common volume, and a shell behind the scene."""

import torch
from shapes import ring

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.reconstruction.initialization import (
    MIN_RADIUS,
    SeedPoints,
    from_points,
    looked_at,
    random_seeds,
    scene_extent,
    shell_points,
    shell_radius,
    shows_surroundings,
)

FOCUS = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
RED, BLUE = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.2, 0.8])


def orbit(count: int = 12) -> Cameras:
    return ring(count, height=0.0, radius=4.0, focal=60.0, size=(64, 48))


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
    for few in (torch.zeros(1, 3), torch.zeros(10, 3)):
        assert torch.isfinite(from_points(seeds_at(few)).log_scales).all()


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


def test_cameras_that_look_elsewhere_do_not_move_the_focus():
    cameras = orbit(24)
    aside = look_at(cameras.centers[:6], torch.tensor([6.0, 6.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    poses = torch.cat([aside, cameras.world_from_camera[6:]])
    focus, reach = looked_at(pinhole(poses, 60.0, width=64, height=48))
    # off by 0.014, because the weights of stray axes are small but not 0; plain least squares is off by 0.48
    assert focus.norm() < 0.04
    assert abs(reach - 4) < 0.04


def test_parallel_cameras_still_have_a_volume():
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-1.0, 0.0, 1.0])
    cameras = pinhole(poses, 60.0, width=64, height=48)
    points = random_seeds(cameras, count=100, seed=0).points
    assert torch.isfinite(points).all()
    assert (points[:, 2] > 0).all()


def test_extent_is_that_of_3dgs():
    # twelve cameras on a circle of radius 4 around their mean; float32 rounding only
    assert abs(scene_extent(orbit()) - 4.4) < 1e-5
    assert scene_extent(orbit()[:1]) == 1.0


def outward(count: int = 8):
    """Return cameras near `FOCUS` that look outwards all around; pictures red above the horizon and blue below."""
    angle = torch.arange(count) * (2 * torch.pi / count)
    direction = torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], 1)
    poses = look_at(FOCUS.float() + 0.1 * direction, FOCUS.float(), torch.tensor([0.0, 0, 1]))
    # turned round
    poses[:, :3, [0, 2]] *= -1
    cameras = list(pinhole(poses, 20.0, width=40, height=30))
    image = torch.cat([RED.expand(15, 40, 3), BLUE.expand(15, 40, 3)])
    return cameras, [image] * count


def test_points_lie_evenly_on_the_sphere_where_cameras_look_in_the_colours_seen_there():
    cameras, images = outward()
    shell = shell_points(cameras, images, center=FOCUS, radius=50.0, count=500, margin_deg=0.0)
    offset = shell.points.double() - FOCUS
    # float32 rounding of numbers around 50
    assert torch.allclose(offset.norm(dim=1), torch.tensor(50.0, dtype=torch.float64), atol=1e-4)
    # about the given number: the border of the seen part cuts through the lattice
    assert 450 <= len(shell) <= 550
    elevation = (offset[:, 2] / 50).asin()
    # half the field of view is atan(15 / 20), 37 degrees in the middle of a picture
    assert elevation.abs().max() < 0.66
    above = elevation > 0.02
    below = elevation < -0.02
    assert torch.allclose(shell.colors[above], RED.expand(int(above.sum()), 3))
    assert torch.allclose(shell.colors[below], BLUE.expand(int(below.sum()), 3))


def test_the_shell_goes_on_beyond_the_pictures_in_the_nearest_colours():
    cameras, images = outward()
    near, far = (shell_points(cameras, images, center=FOCUS, radius=50.0, count=500, margin_deg=m) for m in (0.0, 20.0))
    highest, higher = (((s.points.double() - FOCUS)[:, 2] / 50).asin().max() for s in (near, far))
    # 20 degrees are .35; the lattice of 500 points is .16 apart
    assert 0.19 < higher - highest < 0.51
    top = far.points[:, 2] > near.points[:, 2].max()
    assert torch.allclose(far.colors[top], RED.expand(int(top.sum()), 3))


def test_the_shell_lies_behind_the_known_points_but_for_a_few_wrong_ones():
    points = 20 * torch.nn.functional.normalize(torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    far = torch.cat([points, torch.full((5, 3), 1e4)])
    assert 20 < shell_radius(far, torch.zeros(3, dtype=torch.float64), 1.0) < 40
    assert shell_radius(points[:0], torch.zeros(3, dtype=torch.float64), 2.0) == 2 * MIN_RADIUS


def test_an_object_alone_before_the_background_colour_has_no_surroundings():
    _, images = outward()
    assert shows_surroundings(images, (0.0, 0.0, 0.0))
    alone = torch.zeros(30, 40, 3)
    alone[10:20, 10:20] = RED
    assert not shows_surroundings([alone] * 3, (0.0, 0.0, 0.0))
    assert shows_surroundings([alone] * 3, (1.0, 1.0, 1.0))
