"""The page in a browser: canvas, gizmos, strokes, photos, sizes of windows; and the whole way to the result."""

import io
import math
import os
import random
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo_shadow import SUN, shadows_of
from editor_driver import Editor, Window, history_of, jobs_of, state_of, wait_for_job
from editor_fixtures import address_of
from editor_pages import opened_page, scene_project
from PIL import Image
from shapes import sunlit_scene
from test_state import LIGHT
from tiny_project import ball, photograph, plane

from splatgraft.cli import main
from splatgraft.core.bounds import bounding_sphere
from splatgraft.editor.page.page import PHASES, Page
from splatgraft.editor.page.scene_view import camera_from_viser
from splatgraft.editor.photo_view import PhotoView
from splatgraft.editor.placement import rescale
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.formats import read_capture, read_gaussians, write_gaussians
from splatgraft.project.placement import read_placement
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LightSource, light_to_json
from splatgraft.relighting.light.sun import SET_BY_HAND

PANEL_PX = 372
DRAFT = "a draft of the light"


def with_given_light(project: Path) -> Path:
    """Give the project a light, because surroundings of one plane show too little of it."""
    (project.parent / "light.json").write_text(light_to_json(LIGHT))
    project.write_text(with_keys(project.read_text(), "relight", {"given_light": "light.json"}))
    return project


@pytest.fixture
def project(project: Path) -> Path:
    return with_given_light(project)


def screen(window: Window) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")).astype(float)


def canvas_of(window: Window) -> np.ndarray:
    return screen(window)[:, :-PANEL_PX]


def difference(window: Window, picture: np.ndarray) -> float:
    """Return the median difference of the canvas's lower half from a picture; notifications and gizmos are above."""
    shown = canvas_of(window)
    wanted = np.asarray(Image.fromarray(picture).resize((shown.shape[1], shown.shape[0]))).astype(float)
    return float(np.median(abs(shown - wanted)[shown.shape[0] // 2 : -60]))


def wait_for_the_full_light(window: Window) -> None:
    def is_full() -> bool:
        caption = window.caption()
        return "Light transfer" in caption and "draft" not in caption

    window.until(is_full, what="the full light transfer")


def picture_of(window: Window) -> np.ndarray:
    window.show_phase("Share")
    picture = np.asarray(Image.open(window.download("Picture of this view")).convert("RGB"))
    window.show_phase("Place")
    wait_for_the_full_light(window)
    return picture


def test_the_canvas_is_the_renderer_s_picture_when_the_view_rests(window: Window, page: Page) -> None:
    window.show_phase("Place")
    wait_for_the_full_light(window)
    first = picture_of(window)
    assert first.shape[1] == 1280
    assert first.std() > 5
    # of 255 levels: JPEG, resampling, and rounding to the size of the canvas
    window.until(lambda: difference(window, first) < 3, what="the picture on the canvas")
    # beside the object, which would be dragged
    window.drag((150, 780), (150, 40))
    camera, begun = page.context.guarded.editing().camera, page.context.cameras()[0].centers[0].numpy()
    window.until(lambda: float(np.abs(camera.position - begun).max()) > 0.2, what="another view")
    second = picture_of(window)
    window.until(lambda: difference(window, second) < 3, what="the picture of the new view")
    # F turns to the object, Home goes back to the first view
    session = page.context.require_session()
    placed = session.objects()[0].target_from_object.gaussians(session.placeable_object(0).gaussians)
    middle = bounding_sphere(placed).center.numpy()
    window.page.keyboard.press("f")
    window.until(lambda: float(np.abs(camera.look_at - middle).max()) < 1e-3, what="the view turned to the object")
    window.page.keyboard.press("Home")
    window.until(lambda: float(np.abs(camera.position - begun).max()) < 1e-3, what="the first view again")
    # no key flies the camera
    for key in ("w", "a", "s", "d", "q", "e"):
        window.page.keyboard.down(key)
    window.page.wait_for_timeout(500)
    for key in ("w", "a", "s", "d", "q", "e"):
        window.page.keyboard.up(key)
    assert float(np.abs(camera.position - begun).max()) < 1e-3
    count = len(session.objects())
    window.page.keyboard.press("Control+d")
    window.until(lambda: len(session.objects()) == count + 1, what="a second object")
    assert not page.phases["Place"]._snap.value
    window.page.keyboard.press("Control+z")
    window.until(lambda: len(session.objects()) == count, what="one object again")
    color = np.array([90, 140, 200])

    def of_cameras() -> int:
        return int((abs(screen(window) - color).sum(-1) < 60).sum())

    before = of_cameras()
    window.show_more()
    window.check("Show the cameras")
    window.until(lambda: of_cameras() > before + 500, what="cameras in view")
    # a second window gets the message that it only watches, and edits after the first one is closed
    other = Window.opened(window.page.context, address_of(page))
    notice = "another window edits this project"
    other.says(notice)
    assert window.page.get_by_text(notice).count() == 0
    closed = page.context.guarded.editing()
    assert closed is not None
    window.page.close()
    other.page.get_by_text(notice).wait_for(state="detached")
    other.show_phase("Run")
    other.says("There is no result yet")
    # a picture drawn late for the closed window does not change the state of the other window's script
    page.preview._tell(closed, [], None, ())
    other.show_phase("Place")
    other.until(lambda: bool(told(other)["hulls"]), what="the outline of the object")
    assert window.unknown_errors() == other.unknown_errors() == []
    other.page.close()


def test_a_light_is_dragged_on_the_picture_of_the_sky(browser: Any, project: Path) -> None:
    def height() -> float:
        light = state_of(project).light
        return 0.0 if light is None else light.sources[0].direction[2]

    with opened_page(project) as page:
        window = Window.opened(browser, address_of(page))
        window.show_phase("Light")
        window.says("Set by hand: sun")
        dot, sky = (window.page.locator(f".sg-dome{part}").first for part in (" .sg-light", ""))

        def drag_to_the_middle() -> None:
            begin, whole = dot.bounding_box(), sky.bounding_box()
            start = (begin["x"] + begin["width"] / 2, begin["y"] + begin["height"] / 2)
            middle = (whole["x"] + whole["width"] / 2, whole["y"] + whole["height"] / 2)
            window.drag(start, (middle[0] - start[0], middle[1] - start[1]))

        window.act_until(drag_to_the_middle, lambda: height() > 0.995, what="a light overhead")
        window.says("Set by hand: sun from overhead")
        window.page.keyboard.press("Control+z")
        window.until(lambda: height() < 0.9, what="the light where it was")
        assert window.unknown_errors() == []
        window.page.close()


@pytest.mark.long
def test_an_arrow_of_the_light_is_dragged_under_drafts(browser: Any, project: Path) -> None:
    # a small object has short arrows, which are in view
    session = Session(Project(project))
    session.set_placement(0, rescale(session.placeable_object(0), session.objects()[0].target_from_object, 0.15))

    def height_of_the_sun() -> float:
        light = state_of(project).light
        assert light is not None
        return light.sources[0].direction[2]

    with opened_page(project) as page:
        window = Window.opened(browser, address_of(page))
        window.show_phase("Light")
        window.says("Set by hand: sun")
        wait_for_the_full_light(window)

        def drag_and_release() -> None:
            # the preview shows drafts while the arrow is held
            window.drag_gizmo((0, -60), lambda: DRAFT in window.caption(), what="a draft of the light")
            window.page.mouse.up()

        window.act_until(drag_and_release, lambda: height_of_the_sun() > 0.82, what="a higher sun in light.json")
        wait_for_the_full_light(window)
        window.page.close()


def click_at(window: Window, page: Page, point: torch.Tensor) -> None:
    """Click on a point of the scene in the canvas."""
    canvas, client = window.page.locator("canvas").first.bounding_box(), page.context.guarded.editing()
    assert client is not None
    camera = camera_from_viser(client.camera, width=round(canvas["width"]))
    pose = camera.camera_from_world[0]
    seen = camera.intrinsics[0] @ (pose[:3, :3] @ point + pose[:3, 3])
    x, y = (seen[:2] / seen[2]).tolist()
    window.page.mouse.click(canvas["x"] + x, canvas["y"] + y)


def set_the_sun(window: Window, page: Page, pairs: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> LightSource:
    """Set the sun by clicks on points and their shadows, and return it as saved."""
    window.show_phase("Light")
    wait_for_the_full_light(window)
    window.check("Set the sun by two clicks")
    window.says("click what casts a shadow")
    wanted = ("one pair of points", "2 pairs", "3 pairs")
    for (caster, shadow), said in zip(pairs, wanted, strict=False):
        click_at(window, page, caster)
        window.says("now click the same point of its shadow")
        click_at(window, page, shadow)
        window.says(f"the sun by {said}")
    light = page.context.require_session().state.light
    assert light is not None
    return light.sources[0]


@pytest.mark.long
def test_two_clicks_set_the_sun_and_undo_takes_it_back(browser: Any, tmp_path: Path) -> None:
    sun = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, 0.5]), dim=0)
    project = with_given_light(scene_project(tmp_path, target=sunlit_scene(sun, 3.0)))
    assert main(["run", str(project), "--to", "compose"]) == 0
    tops = torch.tensor([[1.0, 0.2, 0.5], [-0.7, -0.8, 0.5]])
    with opened_page(project) as page:
        window = Window.opened(browser, address_of(page))
        found = set_the_sun(window, page, [(top, top - sun * top[2] / sun[2]) for top in tops])
        assert math.degrees(math.acos(float(torch.tensor(found.direction) @ sun))) < 3
        assert found.name == SET_BY_HAND
        # by the shadows the sun has 3 times its cosine of the sky's light on the floor
        light = page.context.require_session().state.light
        assert light is not None
        share = found.irradiance[0] * found.direction[2] / float(light.irradiance(torch.tensor([[0.0, 0, 1]]))[0, 0])
        assert share == pytest.approx(3 * float(sun[2]) / (1 + 3 * float(sun[2])), abs=0.08)
        wait_for_the_full_light(window)
        window.undo_until(
            project, lambda: (now := state_of(project).light) is not None and now.sources == LIGHT.sources
        )
        # a point on the shadow first, which is refused
        click_at(window, page, tops[0] - sun * 1.0)
        window.says("now click the same point of its shadow")
        click_at(window, page, tops[0])
        window.says("expected a point that casts a shadow, then its shadow below it")
        assert window.unknown_errors() == []
        window.page.close()


@pytest.mark.long
def test_two_clicks_on_the_demo_s_table_give_its_known_sun_and_a_shadow_as_dark_as_the_cup_s(
    browser: Any, tmp_path: Path
) -> None:
    demo = tmp_path / "demo"
    assert main(["demo", str(demo)]) == 0
    # the cup's rim and the end of its shadow, as clicked by eye
    rim, shadow = torch.tensor([-0.35, -0.08, 0.90]), torch.tensor([-0.26, -0.36, 0.80])
    with opened_page(demo / "project.toml") as page:
        window = Window.opened(browser, address_of(page))
        window.show_phase("Light")
        # both are in view there
        window.show_more()
        window.write("Photo", "25")
        found = set_the_sun(window, page, [(rim, shadow)])
        window.page.close()
    assert found.name == SET_BY_HAND
    assert math.degrees(math.acos(float(torch.tensor(found.direction) @ SUN))) < 3
    assert main(["run", str(demo / "project.toml"), "--to", "relight"]) == 0
    (_, cup, _), (_, bananas, _) = shadows_of(demo, ("relit",))
    # the shares of light that the shadows take
    assert 1 - bananas == pytest.approx(1 - cup, rel=0.2)


def test_strokes_and_clicks_in_a_photo_select_the_object(window: Window, project: Path) -> None:
    def strokes() -> tuple[int, int]:
        """Return the numbers of added and removed Gaussians."""
        found = state_of(project).corrections
        return (0, 0) if found is None else (int((found > 0).sum()), int((found < 0).sum()))

    window.show_phase("Select")
    window.says("The object is orange")

    def drag_a_rectangle() -> None:
        # over the left part of the image, in the middle of the canvas
        window.page.keyboard.down("Shift")
        window.drag((300, 200), (160, 500))
        window.page.keyboard.up("Shift")

    window.act_until(drag_a_rectangle, lambda: strokes()[1] > 0, what="corrections by a rectangle")
    window.undo_until(project, lambda: strokes() == (0, 0))
    window.page.keyboard.press("b")
    window.says("the brush is on")
    # the ball is in the middle of the canvas; a click, then a drag over it
    click = partial(window.page.mouse.click, 470, 450)
    window.act_until(click, lambda: strokes()[1] > 0, what="a click of the brush")
    one = strokes()[1]
    window.act_until(lambda: window.drag((422, 430), (100, 40)), lambda: strokes()[1] > one, what="a stroke")
    window.page.keyboard.press("b")
    window.says("the brush is off")
    window.show_more()
    window.check("Second box")
    window.click("Add")
    # the box begins a tenth larger than the object's, and adds the removed Gaussians in it
    window.until(lambda: strokes()[0] >= 80, what="corrections by the box")
    window.undo_until(project, lambda: strokes() == (0, 0))
    window.check("Second box", False)
    click_into_a_photo(window, project)
    assert window.unknown_errors() == []


def click_into_a_photo(window: Window, project: Path) -> None:
    capture = read_capture(project.parent / "source" / "capture")
    name, photo = capture.cameras.names[1], Image.open(capture.image_paths[1]).convert("RGB")
    window.write("Photo", "2")
    canvas = window.page.locator("canvas").first.bounding_box()
    view = PhotoView(photo.size, (round(canvas["width"]), round(canvas["height"])))
    left, top = view.corner
    size = (round(photo.width * view.scale), round(photo.height * view.scale))
    wanted = np.asarray(photo.resize(size)).astype(float)

    def is_shown() -> bool:
        # the upper half, beside the panel: notifications are below
        there = canvas_of(window)[round(top) : round(top) + size[1] // 2, round(left) : round(left) + size[0]]
        # of 255 levels: JPEG and two resamplings
        return float(np.median(abs(there - wanted[: there.shape[0], : there.shape[1]]))) < 4

    window.until(is_shown, what="the photo on the canvas")
    spot = (0.6 * photo.width, 0.4 * photo.height)
    at = (left + view.scale * spot[0], top + view.scale * spot[1])
    window.act_until(
        lambda: window.page.mouse.click(*at), lambda: state_of(project).prompts is not None, what="a point in the file"
    )
    window.says("1 click in 1 of the photos")
    prompts = state_of(project).prompts
    assert prompts is not None
    assert list(prompts) == [name]
    # to a pixel of the window
    assert prompts[name].inside[0].tolist() == pytest.approx(spot, abs=1.5 / view.scale)
    window.page.keyboard.press("Control+z")
    window.until(lambda: state_of(project).prompts is None, what="the click undone")
    # the view leaves the photo, and a click on the object in the scene counts in a photo that shows it
    window.drag((200, 780), (60, 20))
    window.until(lambda: not is_shown(), what="the scene again")
    window.act_until(
        lambda: window.page.mouse.click(470, 450),
        lambda: state_of(project).prompts is not None,
        what="a click in the scene",
    )
    prompts = state_of(project).prompts
    assert prompts is not None
    assert sum(len(prompt.inside) for prompt in prompts.values()) == 1
    window.page.keyboard.press("Control+z")
    window.until(lambda: state_of(project).prompts is None, what="the click undone")


def told(window: Window) -> dict[str, Any]:
    """Wait for the picture and the one before it, and return the state of the page's script."""
    window.page.locator(".sg-line").wait_for(state="visible")
    return window.page.evaluate("JSON.parse(document.querySelector('.sg-state').textContent)")


def middle_of_the_object(window: Window) -> tuple[float, float]:
    canvas = window.page.locator("canvas").first.bounding_box()
    x, y = np.array(told(window)["hulls"][0]).mean(0)
    return canvas["x"] + x * canvas["width"], canvas["y"] + y * canvas["height"]


def test_hands_move_turn_size_and_lift_the_object(window: Window, page: Page) -> None:
    session = page.context.require_session()
    foot = session.placeable_object(0).base.point
    window.show_phase("Place")
    wait_for_the_full_light(window)

    def placed() -> Any:
        return session.objects()[0].target_from_object

    def version() -> str:
        return window.page.evaluate("document.querySelector('.sg-state').dataset.version")

    def hand(key: str | None, by: tuple[float, float]) -> Any:
        """Drag the object, wait until it is placed and visible there, and return the earlier placement."""
        before, start, shown = placed(), middle_of_the_object(window), version()
        if key is not None:
            window.page.keyboard.press(key)
        window.drag(start, by, release=False)
        # the canvas shows it while it is held, and nothing is saved
        window.page.locator(".sg-drag").wait_for(state="visible")
        assert placed() is before
        window.page.mouse.up()
        window.until(lambda: placed() is not before, what="a new placement")
        window.until(lambda: version() != shown, what="a picture of it")
        return before

    before = hand(None, (60, 30))
    moved = placed().points(foot) - before.points(foot)
    assert float(moved[:2].norm()) > 0.05
    assert abs(float(moved[2])) < 0.05
    assert placed().scale == before.scale
    before = hand("r", (80, 0))
    assert torch.allclose(placed().points(foot), before.points(foot), atol=1e-4)
    assert float((placed().rotation - before.rotation).norm()) > 0.3
    before = hand("s", (60, -40))
    assert placed().scale > 1.1 * before.scale
    before = hand("e", (0, -60))
    assert float(placed().points(foot)[2] - before.points(foot)[2]) > 0.02
    # Escape takes a drag back, and an arrow key is a small step
    before = placed()
    window.drag(middle_of_the_object(window), (50, 20), release=False)
    window.page.keyboard.press("Escape")
    window.page.mouse.up()
    window.until(lambda: not window.page.locator(".sg-drag").is_visible(), what="the end of the drag")
    assert placed() is before
    window.page.keyboard.press("ArrowRight")
    window.until(lambda: placed() is not before, what="a step to the right")
    assert 0.001 < float((placed().translation - before.translation).norm()) < 0.1
    # another window's number and text without a number change nothing
    wait_for_the_full_light(window)
    before, ours = placed(), told(window)["window"]
    base, get = window.page.url.partition("?")[0].rstrip("/"), window.page.request.get
    for number, query, status in (
        (99, "object=0&mode=move&x=0.5&y=0.5", 403),
        (ours, "object=7&mode=move&x=0.5&y=0.5", 400),
        (ours, "object=0&mode=fly&x=0.5&y=0.5", 400),
        (ours, "object=0&mode=move&x=nan&y=0.5", 400),
        (ours, "object=0&mode=move", 400),
    ):
        assert get(f"{base}/hand/grab?window={number}&{query}").status == status
    assert get(f"{base}/hand/drag?window={ours}&x=0.5&y=0.5").status == 400
    assert get(f"{base}/hand/nothing?window={ours}").status == 404
    assert placed() is before
    assert window.unknown_errors() == []


def test_the_divider_shows_the_picture_before_and_a_turning_view_is_never_black(window: Window) -> None:
    mouse, line = window.page.mouse, window.page.locator(".sg-line")
    window.show_phase("Place")
    wait_for_the_full_light(window)
    told(window)
    lit = canvas_of(window)
    rows, half = slice(100, -100), lit.shape[1] // 2
    window.page.keyboard.down("Tab")
    window.until(lambda: float(abs(canvas_of(window) - lit)[rows, 60:].max()) > 25, what="the picture before")
    pasted = canvas_of(window)
    window.page.keyboard.up("Tab")
    box = line.bounding_box()
    mouse.move(box["x"] + 14, box["y"] + 200)
    mouse.down()
    mouse.move(half, 300, steps=4)
    mouse.up()

    def is_half() -> bool:
        return float(abs(canvas_of(window) - pasted)[rows, 60 : half - 30].mean()) < 2

    window.until(is_half, what="the picture before, left of the divider")
    assert float(abs(canvas_of(window) - lit)[rows, half + 30 :].mean()) < 2
    mouse.move(200, 780)
    mouse.down()
    seen = []
    for step in range(12):
        mouse.move(200 + 12 * step, 780 - 3 * step)
        seen.append(float((canvas_of(window)[200:600, 200:600].max(-1) > 20).mean()))
    mouse.up()
    assert min(seen) > 0.3, seen
    assert window.unknown_errors() == []


def test_controls_fit_and_the_scene_is_seen_at_the_sizes_of_a_desktop_a_laptop_and_a_phone(window: Window) -> None:
    page = window.page
    for width, height in ((1280, 800), (1024, 700), (372, 800)):
        page.set_viewport_size({"width": width, "height": height})
        for phase in PHASES:
            window.show_phase(phase)
            buttons = [window.phase_button(name) for name in PHASES]
            boxes: list[Any] = []

            def are_in_a_row(buttons: list[Any] = buttons, boxes: list[Any] = boxes) -> bool:
                # the panel moves when the window has become narrow
                boxes[:] = [one.bounding_box() if one.is_visible() else None for one in buttons]
                return None not in boxes and len({round(box["y"]) for box in boxes}) == 1

            window.until(are_in_a_row, what=f"the steps of {phase} in one row: {boxes}")
            assert boxes[0]["x"] >= 0
            assert boxes[-1]["x"] + boxes[-1]["width"] <= width
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            # a field's text is not cut
            cut = page.evaluate(
                "Array.from(document.querySelectorAll('input[inputmode]')).filter("
                "e => e.offsetParent && e.scrollWidth > e.clientWidth + 1).map(e => e.value)"
            )
            assert cut == [], f"{phase}: {cut}"
            # the middle of the scene, where the gizmo is, is not covered
            assert boxes[0]["x"] > width / 2 or boxes[0]["y"] > height / 2
    assert window.unknown_errors() == []


KEYS = (
    "g",
    "w",
    "r",
    "e",
    "Control+d",
    "b",
    "s",
    "Shift+S",
    "f",
    "Home",
    "Delete",
    "Escape",
    "ArrowLeft",
    "ArrowRight",
    "Control+z",
    "Control+Shift+z",
    "Tab",
)
TEXTS = ("0", "-1", "1e9", "1e30", "nan", "", "0.5", "-", "../../..", "/dev/null", "<b>x</b>", "\u0000", "9" * 400)


def act(window: Window, random_: random.Random) -> None:
    """Do one random action of a user."""
    page, kind = window.page, random_.randrange(8)
    x, y = random_.uniform(5, 1275), random_.uniform(5, 895)
    if kind == 0:
        page.mouse.click(x, y)
    elif kind == 1:
        far = random_.choice((200, 4000))
        window.drag((x, y), (random_.uniform(-far, far), random_.uniform(-far, far)))
    elif kind == 2:
        page.keyboard.press(random_.choice(KEYS))
    elif kind == 3:
        # most errors can occur in the panel
        random_.choice(page.get_by_role("button").all()).click(timeout=1000)
    elif kind == 4:
        field = random_.choice(page.locator("input:not([type=hidden]):not([type=file])").all())
        # viser's own setting: with another address the page would be of no server for the rest of the time
        if not field.input_value(timeout=1000).startswith("ws://"):
            field.fill(random_.choice(TEXTS), timeout=1000)
            field.press("Enter", timeout=1000)
    elif kind == 5:
        page.mouse.dblclick(x, y)
    elif kind == 6 and random_.random() < 0.2:
        # the next one edits while the first one is away
        other = page.context.new_page()
        other.goto(page.url)
        page.reload()
        other.close()
        page.wait_for_selector(".sg-header")
    else:
        page.mouse.wheel(0, random_.uniform(-300, 300))


@pytest.mark.parametrize(
    "seconds", [3.0, pytest.param(float(os.environ.get("SPLATGRAFT_MONKEY_SECONDS", "30")), marks=pytest.mark.long)]
)
def test_random_actions_leave_a_project_that_opens(
    window: Window, page: Page, project: Path, seconds: float, capfd: pytest.CaptureFixture[str]
) -> None:
    from playwright.sync_api import Error as PlaywrightError

    window.show_phase("Place")
    random_, end = random.Random(17), time.monotonic() + seconds
    while time.monotonic() < end:
        # an element that is gone or covered is not clicked
        with suppress(PlaywrightError):
            act(window, random_)
    # the page still answers
    window.page.keyboard.press("Escape")
    window.page.reload()
    window.page.wait_for_selector(".sg-header")
    if page.context.session is not None:
        # the window is closed while a job runs
        with page.context.reported():
            page.context.run("compose", "a job")
    assert window.unknown_errors() == []
    assert "Traceback" not in capfd.readouterr().err
    page.close()
    if (job := page.context.session) is not None and (child := job.jobs._child) is not None:
        job.jobs.cancel()
        child.wait()
    if project.is_file():
        session = Session(Project(project))
        # no decision is lost
        if (last := page.context.session) is not None:
            assert history_of(project)["present"] == last.history.present
        while session.undo():
            pass
        Session(Project(project))
        assert main(["run", str(project), "--to", "compose"]) == 0


RESULTS = ("object/object.ply", "composite/scene.ply", "relit/scene.ply", "result/scene.ply")


def object_at(project: Path) -> torch.Tensor:
    return read_placement(project.parent / "placement.json").objects[0].target_from_object.translation


@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=pytest.mark.long)])
def test_the_whole_way_from_photos_to_the_shared_page_by_hand(browser: Any, tmp_path: Path, killed: bool) -> None:
    photograph(tmp_path / "photos", plane((0.3, 0.5, 0.3)), ball())
    write_gaussians(tmp_path / "target.ply", plane((0.5, 0.45, 0.6)))
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor.url)
        window = open_scenes(window, browser, editor, tmp_path)
        select(window, project)
        window = place(window, browser, editor, project)
        light(window, project)
        window.show_phase("Run")
        window.start_job(project, "Update result")
        if killed:
            editor, window = kill_the_editor_during_a_job(window, browser, editor, project)
        window.finish_job(project)
        share(window, project)
        if killed:
            as_by_commands(project, tmp_path, share_exactly(window, project))
        assert editor.end() == 0
        # the page says that it has no editor any more, and does not call its state saved
        window.page.locator("#sg-dead").wait_for(state="visible")
        assert not window.page.locator(".sg-saved").is_visible()
        # otherwise it would connect to the next editor at this port
        window.page.close()
    finally:
        if editor.process.poll() is None:
            editor.kill()


def open_scenes(window: Window, browser: Any, editor: Editor, root: Path) -> Window:
    project = root / "project" / "project.toml"
    window.write("Object from", str(root / "nowhere"))
    window.upload("Upload a video or a scene", root / "target.ply")
    window.says("target.ply: stored as")
    # it names the kind of a path before any work
    window.says("expected photos, a video, a posed capture or a scene, found nothing there")
    assert window.page.get_by_role("button", name="Start the project").is_disabled()
    window.write("Object from", str(root / "photos"))
    window.says("a capture of 8 images with poses, 8 of 8 photos have masks")
    window.click("Start the project")
    window.says("the project is made")
    # changes by hand while the editor is open are loaded
    text = project.read_text()
    tables: tuple[tuple[str, dict[str, Any]], ...] = (
        ("reconstruct", {"iterations": 60, "budget": 400, "sh_degree": 1}),
        ("target", {"views": 8, "picture_width": 160}),
        ("segment", {"solidify": 4, "threshold": 0.5}),
        ("consolidate", {"passes": 1}),
    )
    for table, keys in tables:
        text = with_keys(text, table, keys)
    project.write_text(text)
    window.says("changed outside the editor")
    # the job goes on while no window is open
    window.start_job(project, "Reconstruct both scenes")
    window.page.close()
    window = Window.opened(browser, editor.url)
    state = jobs_of(project).state
    window.until(lambda: window.shows_job() or not ((job := state()) and job.live), what="the job on the page")
    window.finish_job(project)
    window.says("Place into: ready, without photographs")
    assert (project.parent / "target" / "scene" / "scene.ply").read_bytes() == (root / "target.ply").read_bytes()
    return window


def select(window: Window, project: Path) -> None:
    window.show_phase("Select")
    window.says("Click on the object")
    window.start_job(project, "Cut out the object")
    window.says("The object is orange")
    colors = read_gaussians(project.parent / "object" / "object.ply").sh[:, 0]
    assert len(colors) > 20
    assert float((colors[:, 0] > colors[:, 1]).float().mean()) > 0.9


def place(window: Window, browser: Any, editor: Editor, project: Path) -> Window:
    window.show_phase("Place")
    window.click("Find a place")
    window.until((project.parent / "placement.json").is_file, what="a placement")
    found = object_at(project)

    def scale() -> float:
        return read_placement(project.parent / "placement.json").objects[0].target_from_object.scale

    window.write("Scale", "0.5", effect=lambda: abs(scale() - 0.5) < 1e-6)
    window.undo_until(project, lambda: torch.equal(object_at(project), found) and abs(scale() - 0.5) > 1e-6)
    window.click("Duplicate")
    window.until(lambda: len(state_of(project).objects or ()) == 2, what="two objects")
    window.page.keyboard.press("Control+z")
    window.until(lambda: len(state_of(project).objects or ()) == 1, what="one object again")
    # a window that opens now has the object in view
    window.page.close()
    window = Window.opened(browser, editor.url)
    window.show_phase("Place")

    def is_in_the_middle() -> bool:
        hulls = told(window)["hulls"]
        return bool(hulls) and bool((abs(np.array(hulls[0]).mean(0) - 0.5) < 0.2).all())

    # a page that has just opened may not hear a key yet
    window.act_until(lambda: window.page.keyboard.press("f"), is_in_the_middle, what="the object in the middle")
    wait_for_the_full_light(window)
    before = object_at(project)

    def drag() -> None:
        window.drag(middle_of_the_object(window), (40, 30))

    window.act_until(drag, lambda: not torch.equal(object_at(project), before), what="the object dragged")
    moved = object_at(project)
    window.click("Drop")
    window.says("dropped")
    assert float((moved - before).norm()) > 0.01
    return window


def light(window: Window, project: Path) -> None:
    window.show_phase("Light")
    # the light is that of one plane, which shows little of it
    window.write("Shadow strength", "0.5", effect=lambda: state_of(project).weights.shadow == 0.5)


def kill_the_editor_during_a_job(window: Window, browser: Any, editor: Editor, project: Path) -> tuple[Editor, Window]:
    steps = len(history_of(project)["past"])
    # the page first: its failing attempts to connect again would delay those of the next one
    window.page.close()
    editor.kill()
    editor = Editor(project)
    window = Window.opened(browser, editor.url)
    wait_for_job(project)
    assert (project.parent / "result" / "scene.ply").is_file()
    # undo survives the kill
    window.show_phase("Light")
    window.undo_until(project, lambda: state_of(project).weights.shadow == 1.0)
    window.click("Redo")
    window.until(lambda: len(history_of(project)["past"]) == steps, what="the weight again")
    return editor, window


def share(window: Window, project: Path) -> None:
    window.show_phase("Share")
    # first of all, a page
    page = window.download("Write and download").read_bytes()
    assert page.startswith(b"<!doctype html>")
    window.says(" MB in ")
    assert (project.parent / "export" / "project.html").is_file()
    fetch = partial(window.page.request.get, timeout=0)
    base = window.page.url.partition("?")[0].rstrip("/") + "/files/"
    assert fetch(base + "export/project.html").body() == page
    assert not fetch(base + "../project.toml").ok
    assert not fetch(base + "export/../project.toml").ok


def share_exactly(window: Window, project: Path) -> bytes:
    window.choose("As", "Scene, exact (.ply)")
    shared = window.download("Write and download").read_bytes()
    window.says(" MB in ")
    assert main(["export", str(project), "--to", str(project.parent / "exported.ply")]) == 0
    assert shared == (project.parent / "exported.ply").read_bytes()
    return shared


def as_by_commands(project: Path, root: Path, shared: bytes) -> None:
    # the same edits in another folder
    again = root / "again" / "project.toml"
    again.parent.mkdir()
    shutil.copytree(project.parent / "uploads", again.parent / "uploads")
    for name in ("project.toml", "placement.json"):
        shutil.copy(project.parent / name, again.parent / name)
    assert str(root) not in (again.parent / "placement.json").read_text()
    assert main(["run", str(again), "--to", "consolidate"]) == 0
    for name in RESULTS:
        assert (project.parent / name).read_bytes() == (again.parent / name).read_bytes(), name
    assert main(["export", str(again), "--to", str(root / "again.ply")]) == 0
    assert shared == (root / "again.ply").read_bytes()
