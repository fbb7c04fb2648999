"""Virtual cameras of a scene without images: dense part, up direction, poses without occlusion."""

import math

import pytest
import torch
from shapes import blobs

from splatgraft.capture import VirtualCameraOptions, place_virtual_cameras
from splatgraft.capture.virtual_cameras import dense_part, estimate_scene_up
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.rendering import render


def table(seed: int = 0) -> torch.Tensor:
    """Return a level surface with objects on it, z up, and a far cloud outside of the subject."""
    generator = torch.Generator().manual_seed(seed)
    flat = torch.cat([2 * torch.rand(2000, 2, generator=generator) - 1, torch.zeros(2000, 1)], 1)
    things = 0.5 * torch.rand(800, 3, generator=generator) - torch.tensor([0.25, 0.25, 0.0])
    far = 8 * torch.randn(400, 3, generator=generator)
    return torch.cat([flat, things, far])


def turned_up(rotation: torch.Tensor) -> tuple[torch.Tensor, str, bool]:
    points = table() @ rotation.T
    return estimate_scene_up(points, *dense_part(points))


def test_the_dense_part_is_the_table_not_the_cloud() -> None:
    centre, radius = dense_part(table())
    assert float(centre.norm()) < 0.25  # a quarter of the table, because the objects pull the middle up
    assert 0.4 < radius < 1.2


@pytest.mark.parametrize("angle", [0.0, 20.0])
def test_up_is_the_side_on_which_things_stand(angle: float) -> None:
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    tilt = torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    y_down = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for rotation in (tilt, tilt @ y_down, tilt @ y_down.T):
        up, why, _ = turned_up(rotation)
        # a fiftieth of the radius is the plane's thickness
        assert float(up @ rotation[:, 2]) > math.cos(0.05), why
    _, why, is_sure = turned_up(tilt)
    assert why.endswith("a guess by the conventions of files")
    assert not is_sure
    assert turned_up(tilt @ y_down.T)[1].endswith("with most Gaussians")


def test_cameras_go_round_the_dense_part_upright_and_see_it() -> None:
    scene = blobs(table(), 0.05)
    found, _ = place_virtual_cameras(scene, VirtualCameraOptions(views=12))
    centre, radius = dense_part(scene.means)
    assert torch.allclose(focus_point(found.cameras), centre, atol=1e-3 * radius)  # float32 lines through one point
    assert torch.allclose(estimate_up(found.cameras), torch.tensor([0.0, 0.0, 1.0]), atol=0.05)
    assert bool((found.cameras.centers[:, 2] > centre[2]).all())
    assert float(render(scene, found.cameras).color.mean((1, 2, 3)).min()) > 0.1


def test_a_wall_is_not_looked_at_from_behind() -> None:
    y, z = torch.meshgrid(torch.linspace(-4, 4, 60), torch.linspace(-1, 6, 50), indexing="ij")
    wall = blobs(torch.stack([torch.full_like(y, 1.0), y, z], -1).reshape(-1, 3), 0.1)
    subject = blobs(torch.cat([table()[:2800]] * 3), 0.05)
    scene = concatenate([subject, wall])
    options = VirtualCameraOptions(views=16, up=(0.0, 0.0, 1.0))
    found, report = place_virtual_cameras(scene, options)
    open_side, _ = place_virtual_cameras(subject, options)
    assert bool((open_side.cameras.centers[:, 0] > 1.0).any())
    assert not bool((found.cameras.centers[:, 0] > 1.0).any())
    assert any("as given" in note.text for note in report)


def room() -> Gaussians:
    """Return four walls, a floor and a ceiling."""
    a, b = torch.meshgrid(torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 24), indexing="ij")
    sides = [torch.stack([a, b, torch.full_like(a, c)], -1).reshape(-1, 3) for c in (-1.0, 1.0)]
    faces = torch.cat([side.roll(turn, 1) for side in sides for turn in range(3)])
    return blobs(faces, 0.08)


def test_a_room_is_seen_from_within_on_request_and_reported_as_hollow() -> None:
    _, report = place_virtual_cameras(room(), VirtualCameraOptions(views=8, up=(0.0, 0.0, 1.0)))
    assert any("look = within" in note.remedy for note in report)
    within, _ = place_virtual_cameras(room(), VirtualCameraOptions(views=8, up=(0.0, 0.0, 1.0), look="within"))
    assert len(within.cameras) == 8
    assert float(within.cameras.centers.abs().max()) < 0.9
    # in all directions, on the whole slightly down
    forward = within.cameras.world_from_camera[:, :3, 2]
    assert float(forward[:, :2].mean(0).norm()) < 0.05
    assert float(forward[:, 2].mean()) < 0
    assert not any(
        "hollow" in note.text for note in place_virtual_cameras(blobs(table(), 0.05), VirtualCameraOptions(views=8))[1]
    )


def test_a_scene_that_shows_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 20 solid"):
        place_virtual_cameras(blobs(table()[:10], 0.05), VirtualCameraOptions())
    with pytest.raises(ValueError, match="expected a direction"):
        VirtualCameraOptions(up=(0.0, 0.0, 0.0))
