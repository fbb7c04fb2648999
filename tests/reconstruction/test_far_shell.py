"""The shell behind the scene: where its points lie, their colours, and when photos show what is around."""

import torch

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.reconstruction.far_shell import MIN_RADIUS, shell_points, shell_radius, shows_surroundings

FOCUS = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
RED, BLUE = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.2, 0.8])


def outward(count: int = 8):
    """Cameras near `FOCUS` that look outwards all around; pictures red above the horizon and blue below."""
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
    # about as many as asked for: the border of the seen part cuts through the lattice
    assert 450 <= len(shell) <= 550
    elevation = (offset[:, 2] / 50).asin()
    # half the field of view is atan(15 / 20), 37 degrees in the middle of a picture
    assert elevation.abs().max() < 0.66
    above = elevation > 0.02
    below = elevation < -0.02
    assert torch.allclose(shell.colors[above], RED.expand(int(above.sum()), 3))
    assert torch.allclose(shell.colors[below], BLUE.expand(int(below.sum()), 3))


def test_no_points_where_no_camera_looks():
    cameras, images = outward(1)
    away = torch.tensor([-500.0, 0, 0])
    assert len(shell_points(cameras, images, center=away, radius=1.0, count=50, margin_deg=15.0)) == 0


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
