"""A second story in a browser: scenes without photographs, uploads, the brush, erasing, aiming a light, a picture."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from editor_driver import Editor, Window, state_of, wait_until, with_browser
from PIL import Image
from test_scenes_without_photos import AROUND_THE_BALL
from tiny_project import ball, plane

from splatgraft.core.gaussians import concatenate
from splatgraft.editor.session.toml_edit import with_keys
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.relighting import light_to_json
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient

SUN = Light(
    sources=(LightSource(direction=(0.0, 0.6, 0.8), irradiance=(2.0, 2.0, 2.0), name="sun"),),
    ambient=fit_ambient(torch.tensor([0.3, 0.3, 0.4])),
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with with_browser() as found:
        yield found


@pytest.mark.timeout(600)
def test_a_story_without_photographs(browser: Any, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "source.ply", concatenate([plane((0.3, 0.5, 0.3)), ball()]))
    write_gaussians(tmp_path / "target.ply", plane((0.5, 0.45, 0.6)))
    write_gaussians(tmp_path / "another.spz", ball())
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor)
        take_over_scenes(window, tmp_path)
        cut_by_the_box(window, project)
        paint(window, project)
        fill_the_target(window, project, tmp_path)
        show_cameras(window)
        aim_the_sun(window, project)
        take_a_picture(window)
        assert window.unknown_complaints() == []
        editor.kill()
        window.page.close()
        editor = Editor(project)
        undo_what_was_before(Window.opened(browser, editor), project)
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            window.page.screenshot(path=tmp_path / "end.png")
            editor.kill()


def take_over_scenes(window: Window, root: Path) -> None:
    window.write("Object from", str(root / "source.ply"))
    window.upload("Upload a video or a scene", root / "target.ply")
    window.says("target.ply: kept as")
    window.click("Start the project")
    window.page.wait_for_selector(".sg-job", timeout=30_000)
    window.quiet()
    window.says("224 Gaussians; it came without photographs")
    assert (root / "project" / "target" / "scene" / "scene.ply").read_bytes() == (root / "target.ply").read_bytes()


def cut_by_the_box(window: Window, project: Path) -> None:
    window.turn("Select")
    window.choose("Masks from", "no masks: all that is in the box")
    window.check("Box around the object")
    wait_until(lambda: state_of(project).box is not None, timeout=20, what="a box in project.toml")
    window.write_all("Box to", AROUND_THE_BALL[3:])
    window.write_all("Box from", AROUND_THE_BALL[:3])
    wait_until(lambda: list(state_of(project).box or ()) == AROUND_THE_BALL, timeout=20, what="the typed box")
    window.choose("Keep pieces", "all")
    window.says("80 of 224 Gaussians are inside the box")
    window.click("Cut out the object")
    window.says("Cut out the object: done")
    assert read_gaussians(project.parent / "object" / "object.ply").count == 80


def strokes(project: Path) -> tuple[int, int]:
    """How many Gaussians were added and removed."""
    found = state_of(project).corrections
    return (0, 0) if found is None else (int((found > 0).sum()), int((found < 0).sum()))


def paint(window: Window, project: Path) -> None:
    window.page.keyboard.press("b")
    window.says("the brush is on")
    # the page hears of it a moment after its text
    window.page.wait_for_timeout(600)
    # the ball is in the middle between the two panels; a click, then a drag over it
    window.page.mouse.click(648, 450)
    wait_until(lambda: strokes(project)[1] > 0, timeout=20, what="a click of the brush")
    one = strokes(project)[1]
    window.drag((600, 430), (100, 40))
    wait_until(lambda: strokes(project)[1] > one, timeout=20, what="a stroke of the brush")
    window.page.keyboard.press("b")
    window.says("the brush is away")
    window.check("Box for strokes")
    window.click("Add")
    # the box begins a tenth larger than the object's, and takes back what was removed in it
    wait_until(lambda: strokes(project)[0] >= 80, timeout=20, what="what the box adds")
    for _ in range(3):
        window.click("Undo")
        window.page.wait_for_timeout(300)
    wait_until(lambda: strokes(project) == (0, 0), timeout=20, what="all strokes undone")
    window.check("Box for strokes")


def fill_the_target(window: Window, project: Path, root: Path) -> None:
    window.turn("Place")
    window.click("Find a place for it")
    wait_until(lambda: len(state_of(project).objects or ()) == 1, timeout=30, what="a placed object")
    window.unfold("Another object")
    window.upload("Upload a file", root / "another.spz")
    wait_until(lambda: len(state_of(project).objects or ()) == 2, timeout=30, what="an object from a file")
    chosen = window.field("Object")
    wait_until(lambda: chosen.input_value() == "2: another.spz", timeout=20, what="the new object chosen")
    window.unfold("Erase from the target")
    window.check("Show the box")
    window.click("Erase what is in the box")
    window.says("Gaussians of the target")
    erased = state_of(project).erased
    assert erased is not None
    assert 0 < int(erased.sum()) < len(erased)
    window.click("Undo")
    wait_until(lambda: state_of(project).erased is None, timeout=20, what="all back")


def pixels_like(window: Window, color: tuple[int, int, int]) -> int:
    picture = np.asarray(Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")).astype(int)
    return int((abs(picture - np.array(color)).sum(-1) < 60).sum())


def show_cameras(window: Window) -> None:
    color = (90, 140, 200)
    before = pixels_like(window, color)
    window.check("Show the cameras")
    wait_until(lambda: pixels_like(window, color) > before + 500, timeout=20, what="cameras in view")
    window.check("Show the cameras")


def aim_the_sun(window: Window, project: Path) -> None:
    # surroundings of one plane are too little to estimate a light from: one is given
    (project.parent / "light.json").write_text(light_to_json(SUN))
    project.write_text(with_keys(project.read_text(), "relight", {"given_light": "light.json"}))
    window.says("changed outside the editor")
    window.turn("Light")
    window.says("sun 53")
    window.drag(window.handle_of_the_gizmo(), (0, -60), release=False)
    # a draft of its light while the arrow is held
    window.says("a draft of the light", timeout=20)
    window.page.mouse.up()
    wait_until(lambda: height_of_the_sun(project) > 0.82, timeout=20, what="a higher sun in light.json")
    window.says("light in")


def height_of_the_sun(project: Path) -> float:
    light = state_of(project).light
    assert light is not None
    return light.sources[0].direction[2]


def take_a_picture(window: Window) -> None:
    window.turn("Run")
    with window.page.expect_download() as download:
        window.click("Picture of this view")
    picture = np.asarray(Image.open(download.value.path()))
    assert picture.shape[1] == 1280
    assert picture.std() > 5


def undo_what_was_before(window: Window, project: Path) -> None:
    window.turn("Light")
    window.click("Undo")
    wait_until(lambda: height_of_the_sun(project) == 0.8, timeout=20, what="the sun as it was given")
    window.click("Redo")
    wait_until(lambda: height_of_the_sun(project) > 0.82, timeout=20, what="the sun as it was aimed")
