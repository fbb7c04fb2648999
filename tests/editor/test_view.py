"""The view: dragged objects, the camera, lights on the picture of the sky, and the stream of pictures."""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import torch
from editor_pages import Client, opened_editor
from shapes import blobs
from test_state import LIGHT

from splatgraft.cli import main
from splatgraft.composition import Support
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.rotations import rotation_about
from splatgraft.core.similarity import Similarity
from splatgraft.editor.drag import Drag, DragMode, outline
from splatgraft.editor.editor import Editor
from splatgraft.editor.light_panel import SkyDome, with_direction
from splatgraft.editor.orbit import FreeSpace, Orbit, through
from splatgraft.editor.pictures import draw
from splatgraft.editor.session import Session
from splatgraft.editor.stream import View
from splatgraft.formats import read_gaussians
from splatgraft.relighting import LightSource

UP = torch.tensor([0.0, 0.0, 1.0])


def pixel(camera: Cameras, point: torch.Tensor) -> np.ndarray:
    """Return a point's position in a view, over its width and height, by numpy alone."""
    pose = np.linalg.inv(camera.world_from_camera[0].double().numpy())
    seen = camera.intrinsics[0].double().numpy() @ (pose[:3, :3] @ point.double().numpy() + pose[:3, 3])
    return seen[:2] / seen[2] / (camera.width, camera.height)


# a dragged object


def grabbed(session: Session) -> Drag:
    camera = session.scenes.cameras("target")[0]
    item, placed = session.placeable_object(0), session.objects()[0].target_from_object
    return Drag(item, placed, camera, session.scenes.scene("target"), up=session.up())


def foot(drag: Drag, placed: Similarity) -> torch.Tensor:
    return placed.points(drag.item.base.point)


def at(drag: Drag, mode: DragMode, x: float, y: float) -> Similarity:
    return drag.at(mode, (0.5, 0.5), (x, y))


def test_a_moved_object_follows_the_pointer_on_its_support(session: Session) -> None:
    drag, camera = grabbed(session), session.scenes.cameras("target")[0]
    begun = foot(drag, drag.placed)
    for dx, dy in ((0.05, 0.02), (-0.06, 0.04), (0.02, -0.03)):
        placed = at(drag, "move", 0.5 + dx, 0.5 + dy)
        moved = foot(drag, placed)
        # the plane's blobs are 0.02 thick: seen at 35 degrees, two hundredths of the height
        assert np.abs(pixel(camera, moved) - pixel(camera, begun) - (dx, dy)).max() < 0.03
        assert abs(float(moved[2] - begun[2])) < 0.05
        # the same place has the same placement, however the pointer came there: nothing jumps on release
        again = at(drag, "move", 0.5 + dx, 0.5 + dy)
        assert torch.allclose(again.translation, placed.translation, atol=1e-6)
    assert at(drag, "turn", 0.5, 0.4).scale == drag.placed.scale


def test_a_dragged_object_follows_a_slope_and_not_the_noise_of_its_support(session: Session) -> None:
    drag, angles = grabbed(session), [0.0, 0.5, 1.0, 4.0, 4.5]
    found = []
    for angle in angles:
        normal = rotation_about(torch.tensor([0.0, 1.0, 0.0]), math.radians(angle)).float() @ drag.placed.rotation
        support = Support(torch.zeros(3), normal @ drag.item.base.up, flat_fraction=1.0, obstructed_fraction=0.0)
        with patch("splatgraft.editor.drag.support_below", return_value=support):
            found.append(drag.at("move", (0.5, 0.5), (0.5, 0.5), anywhere=True).rotation @ drag.item.base.up)
    tilts = [math.degrees(math.acos(min(1.0, float(up @ found[0])))) for up in found]
    assert max(tilts[:3]) < 0.02
    assert tilts[3:] == pytest.approx([4.0, 4.0], abs=0.05)


def test_a_moved_object_stops_at_the_edge_of_its_support(session: Session) -> None:
    drag = grabbed(session)
    for x in np.linspace(0.5, 3.0, 12):
        placed = at(drag, "move", float(x), 0.5)
        stands = foot(drag, placed)
        # the plane ends at 1.24, two sigma of its outer blobs; half of the foot may hang over
        assert float(stands[:2].abs().max()) < 1.24 + drag.placed.scale * drag.item.base.radius
        assert abs(float(stands[2] - foot(drag, drag.placed)[2])) < 0.05
    assert float((stands - foot(drag, drag.placed)).norm()) > 0.3


def test_a_lifted_turned_and_sized_object_keeps_its_foot_or_its_place(session: Session) -> None:
    drag = grabbed(session)
    begun, lifted = foot(drag, drag.placed), foot(drag, at(drag, "lift", 0.6, 0.45))
    assert torch.allclose(lifted[:2], begun[:2], atol=1e-4)
    assert float(lifted[2] - begun[2]) > 0.01
    turned = at(drag, "turn", 0.75, 0.2)
    assert torch.allclose(foot(drag, turned), begun, atol=1e-4)
    # a quarter of the width is a quarter of a turn; the front follows the pointer to the right
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert torch.allclose(turned.rotation, quarter @ drag.placed.rotation, atol=1e-2)
    sized = at(drag, "size", 0.6, 0.5)
    assert sized.scale == pytest.approx(drag.placed.scale * math.exp(0.2))
    assert torch.allclose(foot(drag, sized), begun, atol=1e-4)


def test_an_outline_holds_all_of_the_object(session: Session) -> None:
    camera = session.scenes.cameras("target")[0]
    points = session.objects()[0].target_from_object.points(session.placeable_object(0).gaussians.means)
    hull = np.array(outline(points, camera), np.float32)
    for point in points:
        x, y = pixel(camera, point)
        assert cv2.pointPolygonTest(hull, (float(x), float(y)), True) > -1e-3
    assert outline(points - 100 * camera.world_from_camera[0, :3, 2], camera) == []


# the camera


def room() -> Gaussians:
    """Return a floor at height 0 and a wall at x = 2, dense enough to be opaque."""
    a, b = torch.meshgrid(torch.linspace(-2, 2, 33), torch.linspace(0, 4, 33), indexing="ij")
    floor = torch.stack([a, b - 2, torch.zeros_like(a)], -1).reshape(-1, 3)
    wall = torch.stack([torch.full_like(a, 2.0), a, b], -1).reshape(-1, 3)
    return concatenate([blobs(floor, 0.1), blobs(wall, 0.1)])


def test_the_camera_stays_above_the_support_and_out_of_walls() -> None:
    eyes = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [-1.0, 0.0, 1.0]])
    cameras = pinhole(look_at(eyes, torch.tensor([0.0, 0, 0.2]), UP), 300.0, width=400, height=300)
    space = FreeSpace.of(room(), cameras, UP, torch.zeros(3))
    view, up = through(cameras[0], 1.2), UP.double().numpy()
    assert space.kept(view) is view
    # 230 pixels to the right and 46 up, of a canvas of 800, and much more
    for dy in (-46 / 800, -0.2, -0.5, -1.0):
        kept = space.kept(view.turned(230 / 800, dy, up=up))
        assert float(kept.position[2]) >= 0.0
        # it still looks at what it turned around
        assert np.linalg.norm(np.cross(kept.forward, view.pivot - kept.position)) < 1e-6
    wide = Orbit(view.world_from_camera, view.distance, view.half_height)
    for _ in range(4):
        wide = wide.zoomed(2.0, scale=1.0)
    behind = wide.looking(view.pivot, np.array([-1.0, 0.0, -0.1]), wide.distance, up=up)
    assert behind.position[0] > 2.1
    assert space.kept(behind).position[0] < 2.0


def test_a_photo_s_view_shows_all_of_it_on_any_canvas_and_a_turn_comes_back(session: Session) -> None:
    camera = session.scenes.cameras("target")[2]
    view, up = through(camera, 1.5), UP.double().numpy()
    rays = (
        torch.tensor([[0.0, 0, 1], [camera.width, 0, 1], [0, camera.height, 1]])
        @ torch.linalg.inv(camera.intrinsics[0]).T
    )
    corners = rays @ camera.world_from_camera[0, :3, :3].T + camera.centers[0]
    for width, height in ((800, 300), (300, 800)):
        shown = view.camera(width, height)
        found = np.array([pixel(shown, corner) for corner in corners])
        assert found.min() > -1e-4
        assert found.max() < 1 + 1e-4
    back = view.turned(0.2, 0.1, up=up).turned(-0.2, -0.1, up=up)
    assert np.allclose(back.pivot, view.pivot, atol=1e-6)
    assert np.allclose(back.position, view.position, atol=1e-3)  # the photo may be rolled by its estimated up


# lights


def test_a_dragged_light_forgets_what_blocked_its_old_direction() -> None:
    window = replace(LIGHT.sources[0], blockers_within=0.5, uncertainty_deg=4.0)
    moved = with_direction(replace(LIGHT, sources=(window,)), 0, torch.tensor([0.0, 2.0, 0.0])).sources[0]
    assert moved.direction == pytest.approx((0.0, 1.0, 0.0))
    assert (moved.blockers_within, moved.uncertainty_deg) == (math.inf, 0.0)


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


# the stream


@pytest.fixture
def lit(project: Path) -> Iterator[tuple[Editor, Client]]:
    """Return the editor with the light transfer, with a window that has the final light."""
    with opened_editor(project) as editor, Client(editor.server.port).window(size=(240, 160)) as window:
        window.wait(lambda: window.head.get("full") and window.head["caption"] == "full quality", what="the light")
        yield editor, window


def same_picture(editor: Editor, window: Client, tolerance: float) -> None:
    """Assert that the picture at rest is the renderer's own, scaled."""
    view, pictures = editor.editing(), editor.require_session().pictures
    window.settled(242 if window.pixels.shape[1] != 242 else 240, 160)
    assert view is not None
    orbit = editor.orbit(view)
    assert orbit is not None
    height, width = window.pixels.shape[:2]
    own = draw(pictures.lit.scene(editor.shown_state()), orbit.camera(width, height))
    assert np.abs(own.astype(int) - window.pixels).mean() < tolerance


def test_pictures_of_orbit_drag_and_release_are_the_renderer_s_and_end_as_the_step_s_result(
    lit: tuple[Editor, Client],
) -> None:
    editor, window = lit
    session = editor.require_session()
    pictures = session.pictures
    same_picture(editor, window, 2.0)  # JPEG of quality 92
    # moving pictures have a canvas's shape, and end with a full one
    count = len(window.heads)
    for _ in range(6):
        window.send("turn", x=0.02, y=0.0)
        window.listen(0.02)
    window.wait(lambda: len(window.heads) > count and window.head["full"], what="the view at rest")
    same_picture(editor, window, 2.0)
    # the object is held where it is seen, and dragged
    hull = np.array(window.head["hulls"][0])
    x, y = hull.mean(0)
    window.send("pointer", what="down", on="object:0", x=x, y=y, mode="move")
    for step in range(1, 5):
        window.send("pointer", what="move", on="object:0", x=x + 0.02 * step, y=y + 0.01 * step, mode="move")
        window.listen(0.05)
    window.wait(lambda: editor.live is not None, what="the drag")
    dragged = editor.shown_state().objects
    window.send("pointer", what="up", on="object:0", x=x + 0.08, y=y + 0.04, mode="move")
    window.wait(lambda: bool(session.history.at) and editor.live is None, what="the release")
    assert dragged is not None
    moved = session.objects()[0].target_from_object
    window.send("pointer", what="cancel", on="", x=0, y=0)
    window.wait(lambda: pictures.lit.stage(session.placed_state()) == "final", what="the light at the new place")
    window.wait(lambda: window.head["full"] and window.head["caption"] == "full quality", what="its picture")
    same_picture(editor, window, 2.0)
    assert torch.equal(session.objects()[0].target_from_object.translation, moved.translation)
    shown = pictures.lit.scene(session.placed_state())
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    written = read_gaussians(session.files.relit)
    assert torch.equal(written.sh, shown.sh)
    assert torch.equal(written.means, shown.means)
    assert torch.equal(written.opacity_logits, shown.opacity_logits)


def test_the_divider_shows_the_picture_before_on_its_left(editor: Editor, window: Client) -> None:
    window.settled(200, 120)
    first = window.pixels
    # the opening view is the first photo's, to which Home leads back
    window.send("turn", x=0.2, y=0.1)
    window.settled(204, 120)
    window.send("key", key="home")
    view = editor.editing()
    window.wait(lambda: view is not None and view.photo == 0, what="the first view")
    window.settled(200, 120)
    assert np.array_equal(window.pixels, first)
    window.do("before", "Place alone")
    window.do("kind", "Pasted, unlit")
    window.wait(lambda: window.control("before")["value"] == "Place alone", what="the choice")
    window.wait(lambda: window.control("kind")["value"] == "Pasted, unlit", what="the other choice")
    window.settled(202, 120)
    whole = window.pixels.astype(int)
    window.send("split", x=1.0)
    window.wait(lambda: window.head["split"] == 1.0 and window.head["full"], what="the place alone")
    place = window.pixels.astype(int)
    window.send("split", x=0.5)
    window.wait(lambda: window.head["split"] == 0.5 and window.head["full"], what="both")
    both = window.pixels.astype(int)
    assert np.abs(whole - place).mean() > 1
    # JPEG, and its blocks of 16 pixels at the line
    assert np.abs(both[:, :92] - place[:, :92]).mean() < 3
    assert np.abs(both[:, 108:] - whole[:, 108:]).mean() < 3


class LeavingView(View):
    """A view whose photo another thread leaves after the first look at it."""

    asked = 0

    @property
    def photo(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self.asked += 1
        return 0 if self.asked == 1 else None

    @photo.setter
    def photo(self, value: int | None) -> None:
        pass


def test_a_view_may_leave_its_photo_while_the_overlay_is_described(editor: Editor, window: Client) -> None:
    view = editor.editing()
    assert view is not None
    window.step("Select")
    over = editor.panels["Select"].overlay(
        LeavingView(view.window), editor.require_session().scenes.cameras("source")[0]
    )
    assert set(over) == {"dots", "lines"}
