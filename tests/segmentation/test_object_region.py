"""Where the object is looked for: above its support, a table or a wall, also without any sparse point."""

import torch
from object_captures import TABLE, object_capture
from shapes import UP, ring

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.posed_images import PosedImages
from splatgraft.segmentation import default_box
from splatgraft.segmentation.object_region import guess_region, region_of_box


def test_without_points_the_box_is_where_the_optical_axes_meet():
    cameras = ring(8, center=(1.0, 2.0, 0.5))
    box = default_box(PosedImages((), cameras, torch.zeros(0, 3), torch.zeros(0, 3)))
    assert torch.allclose((box.lower + box.upper) / 2, torch.tensor([1.0, 2.0, 0.5]), atol=1e-3)
    # all cameras are 2.9 away: some cube, in view of all
    assert 0.1 < float((box.upper - box.lower).max()) < 2.9


def test_the_table_is_left_out_in_any_frame():
    capture = object_capture("plain")
    points = capture.scene.means[capture.scene.opacities > 0.5]
    region = guess_region(capture.cameras, points)
    inside = region.contains(capture.scene.means)
    assert float((inside & capture.is_object).sum() / capture.is_object.sum()) > 0.9
    assert float((inside & capture.is_object).sum() / inside.sum()) > 0.9
    assert region.support is not None
    # the thickness of a support, 3% of the distances of its points, is one centimetre here
    assert abs(region.support.offset - TABLE) < 0.01


def test_the_support_in_a_box_of_the_user_is_found_and_the_object_s_top_is_none():
    capture = object_capture("plain")
    from splatgraft.segmentation import Box

    box = Box(torch.tensor([-0.2, -0.2, TABLE - 0.1]), torch.tensor([0.2, 0.2, TABLE + 0.4]))
    region = region_of_box(capture.cameras, capture.scene.means, box)
    assert region.support is not None
    assert abs(region.support.offset - TABLE) < 0.01
    top = Box(torch.tensor([-0.2, -0.2, TABLE - 0.6]), torch.tensor([0.2, 0.2, TABLE + 0.02]))
    assert region_of_box(capture.cameras, capture.scene.means, top).support is None


def test_a_wall_supports_what_hangs_on_it():
    generator = torch.Generator().manual_seed(0)
    wall = 3 * torch.rand(4000, 3, generator=generator) - 1.5
    wall[:, 1] = 1.0
    head = 0.15 * torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=1)
    head[:, 1] += 0.8
    angle = torch.linspace(-0.6, 0.6, 9)
    eyes = torch.stack([1.5 * angle.sin(), 0.8 - 1.5 * angle.cos(), torch.zeros(9)], 1)
    poses = look_at(eyes, torch.tensor([0.0, 0.8, 0.0]), UP)
    cameras = pinhole(poses, 120.0, width=160, height=120)
    region = guess_region(cameras, torch.cat([wall, head]))
    assert region.support is not None
    # the wall's normal points to the cameras
    assert float(region.support.normal[1]) < -0.99
    assert not region.contains(wall).any()
    assert float(region.contains(head).float().mean()) > 0.9
    assert region.is_whole
    assert region.allows(head).all()
    assert not region.allows(wall + torch.tensor([0.0, 0.05, 0.0])).any()


def test_what_is_in_the_box_but_apart_is_not_the_object():
    generator = torch.Generator().manual_seed(0)

    def cube(count: int, lower: tuple[float, float, float], upper: tuple[float, float, float]) -> torch.Tensor:
        low, high = torch.tensor(lower), torch.tensor(upper)
        return low + (high - low) * torch.rand(count, 3, generator=generator)

    # an L: its box has an empty corner, in which the end of something else lies
    post, foot = cube(600, (-0.3, -0.1, 0.0), (-0.1, 0.1, 0.6)), cube(600, (-0.3, -0.1, 0.0), (0.3, 0.1, 0.15))
    other = cube(100, (0.2, -0.1, 0.45), (0.3, 0.1, 0.6))
    floor = cube(3000, (-2.0, -2.0, -0.02), (2.0, 2.0, -0.019))
    turn = torch.arange(12) / 12 * 2 * torch.pi
    eyes = torch.stack([2 * turn.cos(), 2 * turn.sin(), torch.full((12,), 1.0)], 1)
    cameras = pinhole(look_at(eyes, torch.tensor([0.0, 0.0, 0.2]), UP), 120.0, width=160, height=120)
    region = guess_region(cameras, torch.cat([post, foot, other, floor]))
    assert region.box.contains(other).float().mean() > 0.9
    assert not region.contains(other).any()
    assert float(region.contains(torch.cat([post, foot])).float().mean()) > 0.9
