"""An object under the pointer, and lights on the picture of the sky: the geometry behind the page's script."""

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from test_state import LIGHT

from splatgraft.core.cameras import Cameras
from splatgraft.core.similarity import Similarity
from splatgraft.editor.grab import Grab, GrabMode, outline
from splatgraft.editor.pictures import Picture, with_object
from splatgraft.editor.session import Session
from splatgraft.editor.sky_dome import SkyDome
from splatgraft.relighting import LightSource

UP = torch.tensor([0.0, 0.0, 1.0])


def grabbed(session: Session, mode: GrabMode) -> Grab:
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    background = session.pictures.without_object(session.placed_state(), 0, camera)
    assert background.depth is not None
    item, placed = session.placeable_object(0), session.objects()[0].target_from_object
    return Grab(item, placed, camera, background.depth, session.up(), mode, (0.5, 0.5))


def pixel(camera: Cameras, point: torch.Tensor) -> np.ndarray:
    """Return a point's position in a view, over its width and height, by numpy alone."""
    pose = np.linalg.inv(camera.world_from_camera[0].double().numpy())
    seen = camera.intrinsics[0].double().numpy() @ (pose[:3, :3] @ point.double().numpy() + pose[:3, 3])
    return seen[:2] / seen[2] / (camera.width, camera.height)


def foot(grab: Grab, placed: Similarity) -> torch.Tensor:
    return placed.points(grab.item.base.point)


def test_a_moved_object_follows_the_pointer_on_its_surface(session: Session) -> None:
    grab = grabbed(session, "move")
    begun = foot(grab, grab.placed)
    for dx, dy in ((0.05, 0.02), (-0.06, 0.04), (0.02, -0.03)):
        moved = foot(grab, grab.at((0.5 + dx, 0.5 + dy)))
        # two pixels of the picture
        assert np.abs(pixel(grab.camera, moved) - pixel(grab.camera, begun) - (dx, dy)).max() < 2 / grab.camera.height
        # the plane's blobs are wider apart than they are thick
        assert abs(float(moved[2] - begun[2])) < 0.08
    # outside of any surface it keeps its height
    empty = replace(grab, depth=np.full_like(grab.depth, np.inf))
    assert abs(float(foot(empty, empty.at((0.55, 0.55)))[2] - begun[2])) < 1e-4
    assert torch.equal(grab.at((0.5, 0.4)).rotation, grab.placed.rotation)


def test_a_lifted_turned_and_sized_object_keeps_its_foot_or_its_place(session: Session) -> None:
    lift = grabbed(session, "lift")
    begun, lifted = foot(lift, lift.placed), foot(lift, lift.at((0.6, 0.45)))
    assert torch.allclose(lifted[:2], begun[:2], atol=1e-4)
    assert float(lifted[2] - begun[2]) > 0.01
    turn = grabbed(session, "turn")
    turned = turn.at((0.75, 0.2))
    assert torch.allclose(foot(turn, turned), begun, atol=1e-4)
    # a quarter of the width is a quarter of a turn; the front follows the pointer to the right
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert torch.allclose(turned.rotation, quarter @ turn.placed.rotation, atol=1e-2)
    size = grabbed(session, "size")
    sized = size.at((0.6, 0.5))
    assert sized.scale == pytest.approx(size.placed.scale * math.exp(0.2))
    assert torch.allclose(foot(size, sized), begun, atol=1e-4)


def test_an_outline_holds_all_of_the_object(session: Session) -> None:
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    points = session.objects()[0].target_from_object.points(session.placeable_object(0).gaussians.means)
    hull = np.array(outline(points, camera), np.float32)
    for point in points:
        x, y = pixel(camera, point)
        assert cv2.pointPolygonTest(hull, (float(x), float(y)), True) > -1e-3
    assert outline(points - 100 * camera.world_from_camera[0, :3, 2], camera) == []


def test_a_dragged_object_is_hidden_by_what_is_before_it(session: Session) -> None:
    camera, placed = session.scenes.cameras(session.files.target_cameras)[0], session.objects()[0].target_from_object
    object_ = placed.gaussians(session.placeable_object(0).gaussians)
    grey = np.full((camera.height, camera.width, 3), 90, np.uint8)
    far, near = (np.full(grey.shape[:2], depth, np.float32) for depth in (1e6, 1e-3))
    assert int((with_object(Picture(grey, far), object_, camera) != grey).sum()) > 100
    assert np.array_equal(with_object(Picture(grey, near), object_, camera), grey)


def test_the_picture_of_the_sky_shows_lights_where_they_are() -> None:
    # the viewer looks along +y, so -x is on the left
    dome = SkyDome.seen_along(torch.tensor([0.0, 1.0, -0.3]), UP)
    for direction in ((0.0, 0.6, 0.8), (0.6, 0.0, 0.8), (-0.48, -0.64, 0.6)):
        x, y = dome.point(torch.tensor(direction))
        assert torch.allclose(dome.direction(x, y), torch.tensor(direction), atol=1e-5)
    assert dome.direction(0.0, 0.0).tolist() == pytest.approx([0, 0, 1])
    # a place beyond the horizon is at it
    assert dome.direction(3.0, 0.0).tolist() == pytest.approx([1, 0, 0], abs=1e-6)
    words = {(0.0, -0.8, 0.6): "from behind you, half high", (-0.95, 0.0, 0.31): "from the left, low"}
    words |= {(0.0, 0.5, 0.87): "from the back, high", (0.0, 0.0, 1.0): "from overhead"}
    for direction, said in words.items():
        assert dome.words(LightSource(direction, (1.0, 1.0, 1.0))) == said
    weak = LightSource((-0.6, 0.0, 0.8), (0.1, 0.1, 0.1), name="<lamp>")
    picture = dome.svg(replace(LIGHT, sources=(*LIGHT.sources, weak)))
    dots = re.findall(r'data-source="(\d)" cx="([-\d.]+)" cy="([-\d.]+)" r="([\d.]+)"', picture)
    assert [dot[0] for dot in dots] == ["0", "1"]
    (_, x, y, large), (_, left, _, small) = dots
    assert (float(x), float(y) < 0, float(left) < 0) == (0.0, True, True)
    assert float(large) > float(small)
    assert "&lt;lamp&gt;" in picture
