"""In the browser: scenes without photographs, uploads, brush, erasing, editing a light, saving an image."""

import io
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from editor_driver import Editor, Window, state_of
from PIL import Image
from test_scenes_without_photos import AROUND_THE_BALL
from tiny_project import ball, plane

from splatgraft.core.gaussians import concatenate
from splatgraft.project.toml_edit import with_keys
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.relighting import light_to_json
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient

SUN = Light(
    sources=(LightSource(direction=(0.0, 0.6, 0.8), irradiance=(2.0, 2.0, 2.0), name="sun"),),
    ambient=fit_ambient(torch.tensor([0.3, 0.3, 0.4])),
)
DRAFT = "a draft of the light"


def test_a_project_of_scenes_without_photographs(browser: Any, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "source.ply", concatenate([plane((0.3, 0.5, 0.3)), ball()]))
    write_gaussians(tmp_path / "target.ply", plane((0.5, 0.45, 0.6)))
    write_gaussians(tmp_path / "another.spz", ball())
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor)
        import_scenes(window, tmp_path)
        cut_by_the_box(window, project)
        paint(window, project)
        fill_the_target(window, project, tmp_path)
        show_cameras(window)
        aim_the_sun(window, project)
        save_an_image(window)
        assert window.unknown_errors() == []
        editor.kill()
        window.page.close()
        editor = Editor(project)
        undo_after_a_restart(Window.opened(browser, editor), project)
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            editor.kill()


def import_scenes(window: Window, root: Path) -> None:
    project = root / "project" / "project.toml"
    window.write("Object from", str(root / "source.ply"))
    window.upload("Upload a video or a scene", root / "target.ply")
    window.says("target.ply: stored as")
    window.start_job(project, "Start the project")
    window.finish_job(project)
    window.says("224 Gaussians; without photographs")
    assert (root / "project" / "target" / "scene" / "scene.ply").read_bytes() == (root / "target.ply").read_bytes()


def cut_by_the_box(window: Window, project: Path) -> None:
    window.show_phase("Select")
    window.choose("Masks from", "no masks: everything inside the box")
    window.check("Box around the object")
    window.until(lambda: state_of(project).box is not None, what="a box in project.toml")
    for label, first in (("Box to", 3), ("Box from", 0)):
        for index in range(3):
            wanted = AROUND_THE_BALL[first + index]

            def is_saved(at: int = first + index, wanted: float = wanted) -> bool:
                return (state_of(project).box or ())[at] == wanted

            window.write_number(label, index, wanted, effect=is_saved)
    assert list(state_of(project).box or ()) == AROUND_THE_BALL
    window.choose("Keep pieces", "all")
    window.says("80 of 224 Gaussians are inside the box")
    window.start_job(project, "Cut out the object")
    window.says("Cut out the object: done")
    assert read_gaussians(project.parent / "object" / "object.ply").count == 80


def strokes(project: Path) -> tuple[int, int]:
    """How many Gaussians were added and removed."""
    found = state_of(project).corrections
    return (0, 0) if found is None else (int((found > 0).sum()), int((found < 0).sum()))


def paint(window: Window, project: Path) -> None:
    window.page.keyboard.press("b")
    window.says("the brush is on")
    # the ball is in the middle of the canvas; a click, then a drag over it
    click = partial(window.page.mouse.click, 470, 450)
    window.act_until(click, lambda: strokes(project)[1] > 0, what="a click of the brush")
    one = strokes(project)[1]
    drag = partial(window.drag, (422, 430), (100, 40))
    window.act_until(drag, lambda: strokes(project)[1] > one, what="a stroke of the brush")
    window.page.keyboard.press("b")
    window.says("the brush is off")
    window.check("Second box")
    window.click("Add")
    # the box begins a tenth larger than the object's, and adds what was removed in it
    window.until(lambda: strokes(project)[0] >= 80, what="corrections by the box")
    window.undo_until(project, lambda: strokes(project) == (0, 0))
    window.check("Second box", False)


def fill_the_target(window: Window, project: Path, root: Path) -> None:
    window.show_phase("Place")
    window.click("Find a place")
    window.until(lambda: len(state_of(project).objects or ()) == 1, what="a placed object")
    window.unfold("Another object")
    window.upload("Upload a file", root / "another.spz")
    window.until(lambda: len(state_of(project).objects or ()) == 2, what="an object from a file")
    chosen = window.field("Object")
    window.until(lambda: chosen.input_value() == "2: another.spz", what="the new object chosen")
    window.unfold("Erase from the target")
    window.check("Show the box")
    window.click("Erase inside the box")
    window.says("Gaussians of the target")
    erased = state_of(project).erased
    assert erased is not None
    assert 0 < int(erased.sum()) < len(erased)
    window.undo_until(project, lambda: state_of(project).erased is None)


def pixels_like(window: Window, color: tuple[int, int, int]) -> int:
    picture = np.asarray(Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")).astype(int)
    return int((abs(picture - np.array(color)).sum(-1) < 60).sum())


def show_cameras(window: Window) -> None:
    color = (90, 140, 200)
    before = pixels_like(window, color)
    window.check("Show the cameras")
    window.until(lambda: pixels_like(window, color) > before + 500, what="cameras in view")
    window.check("Show the cameras", False)


def aim_the_sun(window: Window, project: Path) -> None:
    # surroundings of one plane are too little to estimate a light from: one is given
    (project.parent / "light.json").write_text(light_to_json(SUN))
    project.write_text(with_keys(project.read_text(), "relight", {"given_light": "light.json"}))
    window.says("changed outside the editor")
    window.show_phase("Light")
    window.says("sun 53")
    wait_for_the_full_light(window)

    def drag_and_release() -> None:
        # the preview shows drafts while the arrow is held
        window.drag_gizmo((0, -60), lambda: DRAFT in window.caption(), what="a draft of the light")
        window.page.mouse.up()

    window.act_until(drag_and_release, lambda: height_of_the_sun(project) > 0.82, what="a higher sun in light.json")
    wait_for_the_full_light(window)


def wait_for_the_full_light(window: Window) -> None:
    """Wait until the preview shows the light transfer and neither a draft nor the images before it."""

    def is_full() -> bool:
        caption = window.caption()
        return "Light transfer" in caption and DRAFT not in caption

    window.until(is_full, what="the full light transfer")


def height_of_the_sun(project: Path) -> float:
    light = state_of(project).light
    assert light is not None
    return light.sources[0].direction[2]


def save_an_image(window: Window) -> None:
    window.show_phase("Run")
    picture = np.asarray(Image.open(window.download("Picture of this view")))
    assert picture.shape[1] == 1280
    assert picture.std() > 5


def undo_after_a_restart(window: Window, project: Path) -> None:
    window.show_phase("Light")
    window.undo_until(project, lambda: height_of_the_sun(project) == 0.8)
    window.click("Redo")
    window.until(lambda: height_of_the_sun(project) > 0.82, what="the aimed sun")
