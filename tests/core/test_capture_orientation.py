"""Photos on their side are noticed from the poses alone, and turning them does not change their content."""

import math

import pytest
import torch
from shapes import UP, ring, surfels

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.capture_orientation import quarter_turns, widest_gap
from splatgraft.core.directions import even_directions
from splatgraft.rendering import render

COUNT = 24


def around(last_deg: float = 345.0, height: float = 0.9, roll_deg: float = 4.0) -> Cameras:
    """Return hand-held cameras on a circle that look at its middle."""
    generator = torch.Generator().manual_seed(1)
    angles = torch.linspace(0, math.radians(last_deg), COUNT)
    eyes = torch.stack([2 * angles.cos(), 2 * angles.sin(), height + 0.3 * torch.rand(COUNT, generator=generator)], 1)
    poses = look_at(eyes, torch.zeros(3), UP)
    for pose, turn in zip(poses, math.radians(roll_deg) * torch.randn(COUNT, generator=generator), strict=True):
        c, s = float(turn.cos()), float(turn.sin())
        pose[:3, :3] = pose[:3, :3] @ torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return pinhole(poses, 60.0, width=64, height=48)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_camera_renders_the_turned_picture(quarters: int) -> None:
    points = even_directions(300)
    scene = surfels(0.5 * points, points, width=0.05, srgb=0.5 + 0.4 * points)
    camera = ring()[:1]
    turned = camera.turned(torch.tensor([quarters]))
    expected = torch.rot90(render(scene, camera).color[0], quarters)
    assert float((render(scene, turned).color[0] - expected).abs().max()) < 1e-4
    assert torch.equal(turned.centers, camera.centers)


@pytest.mark.parametrize("quarters", [0, 1, 3])
def test_all_photos_on_their_side_are_turned_back(quarters: int) -> None:
    cameras = around()
    lying = cameras.turned(torch.full((COUNT,), quarters))
    assert quarter_turns(lying.world_from_camera).tolist() == [-quarters % 4] * COUNT


def test_single_photos_are_turned_by_the_others_and_what_is_not_clear_stays() -> None:
    cameras, odd = around(last_deg=150), torch.zeros(COUNT, dtype=torch.long)
    odd[3], odd[7], odd[15] = 1, 2, 3
    assert quarter_turns(cameras.turned(odd).world_from_camera).tolist() == (-odd % 4).tolist()
    # cameras straight above define no upright
    above = around(height=9.0).turned(odd)
    assert quarter_turns(above.world_from_camera).tolist() == [0] * COUNT
    # a short arc may consist of photos that were taken upright along a wall
    lying = around(last_deg=40).turned(torch.ones(COUNT, dtype=torch.long))
    assert quarter_turns(lying.world_from_camera).tolist() == [0] * COUNT


def test_the_widest_gap_is_named_by_the_photographs_beside_it() -> None:
    cameras = around(last_deg=180.0)
    gap, names = widest_gap(cameras, torch.zeros(3))
    # 24 cameras on a half circle
    assert gap == pytest.approx(180, abs=1)
    assert names == (cameras.names[-1], cameras.names[0])
