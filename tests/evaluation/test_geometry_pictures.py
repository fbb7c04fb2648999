"""Depth colours are ordered by distance; normals of planes seen in closed form are exact; edges and holes are black."""

import math

import pytest
import torch
from shapes import UP
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.images import LUMINANCE, linear_from_srgb
from splatgraft.evaluation import depth_colors, normal_colors, normals_from_depth

PITCH_DEG = 30.0
EYE = torch.tensor([[0.0, -2.0, 1.5]])


def camera(pitch_deg: float = PITCH_DEG) -> Cameras:
    """Return a camera at `EYE` that looks along +y and down."""
    aim = EYE[0] + torch.tensor([0.0, 1.0, -math.tan(math.radians(pitch_deg))])
    return pinhole(look_at(EYE, aim, UP), 60.0, width=80, height=60)


def plane_depth(camera: Cameras, normal: Tensor, offset: float) -> Tensor:
    """Return the depth of the plane `normal . x = offset`; 0 if the camera does not see it."""
    rays = camera.rays() @ camera.world_from_camera[0, :3, :3].T
    depth = (offset - camera.centers[0] @ normal) / (rays @ normal)
    return torch.where(depth > 0, depth, 0.0)


def brightness(colors: Tensor) -> Tensor:
    return linear_from_srgb(colors) @ LUMINANCE


def test_colors_fall_along_a_receding_floor() -> None:
    depth = plane_depth(camera(pitch_deg=10.0), UP, 0.0)
    colors = depth_colors(depth)
    horizon = int((depth[:, 40] > 0).int().argmax())
    assert 0 < horizon < 30
    assert (colors[:horizon] == 0).all()
    # from the horizon down to the viewer; the ends beyond the quantiles have one colour each
    rising = brightness(colors[horizon:, 40]).diff()
    assert (rising >= 0).all()
    assert rising.gt(0).float().mean() > 0.8
    # a unit of length does not change the colours; 1e-5 for float32 of a table's interpolation
    assert depth_colors(1000 * depth).sub(colors).abs().max() < 1e-5
    assert (depth_colors(torch.zeros(4, 5)) == 0).all()


@pytest.mark.parametrize(
    ("normal", "offset", "expected"),
    [
        # in OpenGL axes of a camera that looks down by the pitch
        (UP, 0.0, (0.0, math.cos(math.radians(PITCH_DEG)), math.sin(math.radians(PITCH_DEG)))),
        (torch.tensor([-1.0, 0.0, 0.0]), -1.5, (-1.0, 0.0, 0.0)),
    ],
)
def test_normals_of_a_plane_are_its_own(normal: Tensor, offset: float, expected: tuple[float, ...]) -> None:
    depth = plane_depth(camera(), normal, offset)
    normals = normals_from_depth(depth, camera())
    shown = (normals != 0).any(-1)
    assert shown.float().mean() > 0.4
    assert not shown[depth == 0].any()
    # a difference is a thirtieth of its coordinates (two pixels of 60 per depth): 30 roundings of 6e-8, some of them
    assert normals[shown].sub(torch.tensor(expected)).abs().max() < 1e-5


def test_a_floor_is_green_a_wall_blue_and_the_edge_of_a_box_black() -> None:
    view = camera()
    colors = normal_colors(normals_from_depth(plane_depth(view, UP, 0.0), view))
    assert (colors[30:].argmax(-1) == 1).all()
    level = camera(pitch_deg=0.0)
    wall = plane_depth(level, torch.tensor([0.0, 1.0, 0.0]), 2.0)
    colors = normal_colors(normals_from_depth(wall, level))
    assert (colors.argmax(-1) == 2).all()
    # a nearer wall before the right half
    wall[:, 40:] = 3.0
    colors = normal_colors(normals_from_depth(wall, level))
    black = (colors == 0).all(-1)
    assert black[:, 39:41].all()
    assert not black[:, :39].any()
    assert not black[:, 41:].any()
