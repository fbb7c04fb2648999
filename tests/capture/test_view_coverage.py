"""Posed views that are too few or stand in one place are refused with what is needed."""

import pytest
import torch
from made_captures import ring

from splatgraft.capture import median_parallax_deg, require_coverage
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.posed_images import PosedImages

NO_POINTS = torch.zeros(0, 3)


def capture(cameras: Cameras, points: torch.Tensor = NO_POINTS) -> PosedImages:
    return PosedImages(
        image_paths=(),
        cameras=cameras,
        points=points,
        point_colors=torch.zeros_like(points),
    )


def cloud(count: int = 80) -> torch.Tensor:
    return 0.3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(1))


def side_by_side(count: int, step: float, distance: float) -> Cameras:
    """Parallel cameras on a line, `distance` before the origin."""
    x = (torch.arange(count) - (count - 1) / 2) * step
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, 0, 3], poses[:, 2, 3] = x, -distance
    return pinhole(poses, 150.0, width=160, height=120)


def outwards(count: int) -> Cameras:
    """From one place into all directions."""
    angle = torch.arange(count) * (2 * torch.pi / count)
    goal = torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], -1)
    poses = torch.cat([look_at(torch.zeros(1, 3), g, torch.tensor([0.0, 0, 1])) for g in goal])
    return pinhole(poses, 150.0, width=160, height=120)


@pytest.mark.parametrize("points", [NO_POINTS, cloud()])
def test_a_ring_is_enough(points):
    require_coverage(capture(ring(8), points), "here")
    # cameras opposite each other at 2 around and 1 above the points: 2 atan(2 / 1) = 127 degrees
    found = median_parallax_deg(ring(8), points)
    assert found is not None
    assert 110 < found < 150


def test_three_views_are_too_few():
    with pytest.raises(ValueError, match=r"^here: expected at least 8 posed views with a parallax of 3 .*found 3$"):
        require_coverage(capture(ring(3), cloud()), "here")


@pytest.mark.parametrize("points", [NO_POINTS, cloud() + torch.tensor([3.0, 0, 0])])
def test_cameras_at_one_point_are_refused(points):
    with pytest.raises(ValueError, match=r"found 20 views with 0 degrees: the cameras stand in one place"):
        require_coverage(capture(outwards(20), points), "here")


def test_parallax_is_the_angle_between_the_outermost_cameras():
    # 10 cameras, 9 steps of 0.01, 10 away: 0.5 degrees
    narrow = median_parallax_deg(side_by_side(10, 0.01, 10.0), cloud())
    assert narrow == pytest.approx(0.516, rel=0.05)
    with pytest.raises(ValueError, match=r"found 10 views with 0\.5"):
        require_coverage(capture(side_by_side(10, 0.01, 10.0), cloud()), "here")
    require_coverage(capture(side_by_side(10, 0.1, 10.0), cloud()), "here")


def test_a_walk_that_looks_outwards_without_points_is_not_refused():
    cameras = outwards(12)
    cameras.world_from_camera[:, :3, 3] = 0.3 * torch.randn(12, 3, generator=torch.Generator().manual_seed(2))
    require_coverage(capture(cameras), "here")
