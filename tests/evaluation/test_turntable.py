"""The turntable is a closed path that looks at the object and stays within the captured viewpoints."""

import math

import pytest
import torch
from shapes import UP

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.evaluation.turntable import TurntableOptions, turntable_cameras

CENTER = torch.tensor([0.3, -0.2, 0.5])


def captured(start_deg, end_deg, *, count=24, up=(0.0, 0.0, 1.0), seed=0):
    g = torch.Generator().manual_seed(seed)
    angle = torch.linspace(math.radians(start_deg), math.radians(end_deg), count)
    distance, height = 2 + torch.rand(count, generator=g), 0.5 + torch.rand(count, generator=g)
    eyes = CENTER + torch.stack([distance * angle.cos(), distance * angle.sin(), height], -1)
    return pinhole(look_at(eyes, CENTER, torch.tensor(up)), 300.0, width=320, height=240)


def angles_and_rings(cameras):
    offset = cameras.centers - CENTER
    return torch.atan2(offset[:, 1], offset[:, 0]), offset[:, :2].norm(dim=-1), offset[:, 2]


@pytest.mark.parametrize("span", [(0, 345), (20, 140)])
def test_path_is_smooth_closed_and_within_the_capture(span):
    source = captured(*span)
    path = turntable_cameras(source, CENTER, up=UP)
    _, ring, level = angles_and_rings(path)
    _, source_ring, source_level = angles_and_rings(source)
    # weighted means cannot leave the range; 1e-4 for float32 of coordinates up to 3
    assert ring.min() >= source_ring.min() - 1e-4
    assert ring.max() <= source_ring.max() + 1e-4
    assert level.min() >= source_level.min() - 1e-4
    assert level.max() <= source_level.max() + 1e-4
    steps = (path.centers - path.centers.roll(1, 0)).norm(dim=-1)
    # 60 steps around a circle of radius 3 are 0.31 each; a cosine arc of 120 degrees is at most pi/2 of its mean step
    assert steps.max() < 0.6
    assert len(path) == 60


def test_every_frame_looks_at_the_center_upright():
    path = turntable_cameras(captured(0, 345), CENTER, up=UP)
    in_camera = torch.einsum("vij,j->vi", path.camera_from_world[:, :3, :3], CENTER) + path.camera_from_world[:, :3, 3]
    assert in_camera[:, :2].abs().max() < 1e-5  # float32 rotation of coordinates up to 3
    assert path.world_from_camera[:, 2, 0].abs().max() < 1e-6
    assert (path.world_from_camera[:, 2, 1] < 0).all()


def test_an_arc_is_never_left_and_a_full_ring_is_gone_round():
    angle, _, _ = angles_and_rings(turntable_cameras(captured(20, 140), CENTER, up=UP))
    assert math.degrees(angle.min()) >= 20 - 1e-3
    assert math.degrees(angle.max()) <= 140 + 1e-3
    angle, _, _ = angles_and_rings(turntable_cameras(captured(0, 345), CENTER, up=UP))
    ordered = angle.sort().values
    assert (ordered[1:] - ordered[:-1]).max() < math.radians(6 + 0.1)  # 360 / 60


def test_turning_the_world_turns_the_path():
    rotation = rotation_from_quaternion(torch.tensor([[0.5, 0.3, -0.7, 0.2]]))[0]
    source = captured(0, 345)
    poses = source.world_from_camera.clone()
    poses[:, :3] = rotation @ poses[:, :3]
    turned = pinhole(poses, 300.0, width=320, height=240)
    straight = turntable_cameras(source, CENTER, up=UP)
    other = turntable_cameras(turned, rotation @ CENTER, up=rotation[:, 2])
    # a full circle may start elsewhere: sets of rings agree
    assert other.centers.mean(0).sub(rotation @ straight.centers.mean(0)).abs().max() < 0.02


@pytest.mark.parametrize("span", [(0, 345), (20, 140)])
def test_it_starts_where_it_is_told_to(span):
    start = torch.tensor([math.cos(math.radians(100)), math.sin(math.radians(100)), 0.0])
    path = turntable_cameras(captured(*span), CENTER, up=UP, options=TurntableOptions(frames=36, start=start))
    # frames of a full circle are 10 degrees apart; those of an arc of 120 degrees, back and forth, at most as much
    assert math.degrees(float(angles_and_rings(path)[0][0])) == pytest.approx(100, abs=6)


def test_zoom_multiplies_the_focal_length():
    options = TurntableOptions(frames=5, zoom=1.5)
    path = turntable_cameras(captured(0, 345), CENTER, up=UP, options=options)
    assert float(path.intrinsics[0, 0, 0]) == pytest.approx(450)
    assert len(path) == 5
