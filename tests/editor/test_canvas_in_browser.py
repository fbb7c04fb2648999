"""The canvas shows the renderer's picture when the view rests, splats while it moves, and gizmos over both."""

import io
from pathlib import Path

import numpy as np
import torch
from editor_driver import Window, state_of
from PIL import Image
from test_hostile_values import made, project

__all__ = ["made", "project"]
PANEL_PX = 372


def canvas_of(window: Window) -> np.ndarray:
    shot = Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")
    return np.asarray(shot.crop((0, 0, shot.width - PANEL_PX, shot.height))).astype(float)


def difference(window: Window, picture: np.ndarray) -> float:
    """Median difference of the lower half of the canvas from a picture: notifications and gizmos are above."""
    shown = canvas_of(window)
    size = (shown.shape[1], shown.shape[0])
    wanted = np.asarray(Image.fromarray(picture).resize(size)).astype(float)
    half = shown.shape[0] // 2
    return float(np.median(abs(shown - wanted)[half:-60]))


def is_final(window: Window) -> bool:
    return "Light transfer" in window.caption() and "draft" not in window.caption()


def picture_of(window: Window) -> np.ndarray:
    window.show_phase("Run")
    picture = np.asarray(Image.open(window.download("Picture of this view")).convert("RGB"))
    window.show_phase("Place")
    window.until(lambda: is_final(window), what="the final picture")
    return picture


def test_the_canvas_is_the_renderer_s_picture_when_the_view_rests(window: Window) -> None:
    window.show_phase("Place")
    window.until(lambda: is_final(window), what="the final picture")
    first = picture_of(window)
    # of 255 levels: JPEG, resampling, and rounding to the size of the canvas
    window.until(lambda: difference(window, first) < 3, what="the picture on the canvas")
    window.drag((450, 700), (150, 40))
    window.until(lambda: difference(window, first) > 6, what="another view")
    second = picture_of(window)
    window.until(lambda: difference(window, second) < 3, what="the picture of the new view")
    # without the canvas the window shows splats, which have one colour per Gaussian and no light
    window.check("Draw on the canvas", False)
    window.until(lambda: difference(window, second) > 3, what="splats")
    assert window.unknown_errors() == []


def test_a_window_that_watches_shows_the_same_picture_and_its_own_views(window: Window) -> None:
    window.show_phase("Place")
    window.until(lambda: is_final(window), what="the final picture")
    first = picture_of(window)
    page = window.page.context.new_page()
    page.goto(window.page.url)
    watcher = Window(page)
    watcher.click("Watch")
    watcher.until(lambda: difference(watcher, first) < 3, what="the picture of the editing window's view")
    watcher.drag((450, 700), (150, 40))
    watcher.until(lambda: difference(watcher, first) > 6, what="another view")
    # the editing window looks from there too: its own picture tells whether the watcher's is one or splats
    window.drag((450, 700), (150, 40))
    second = picture_of(window)
    watcher.until(lambda: difference(watcher, second) < 3, what="the picture of the watcher's view")
    window.check("Draw on the canvas", False)
    watcher.until(lambda: difference(watcher, second) > 3, what="splats")
    window.check("Draw on the canvas", True)
    watcher.until(lambda: difference(watcher, second) < 3, what="the picture again")
    watcher.click("Edit here instead")
    watcher.until(lambda: is_final(watcher), what="the final picture of the new editing window")
    assert watcher.unknown_errors() == window.unknown_errors() == []
    page.close()


def test_a_duplicate_stands_beside_the_original(window: Window, project: Path) -> None:
    window.show_phase("Place")
    window.until(lambda: is_final(window), what="the final picture")
    window.click("Duplicate")
    window.until(lambda: len(state_of(project).objects or ()) == 2, what="two objects")
    objects = state_of(project).objects
    assert objects is not None
    apart = objects[1].target_from_object.translation - objects[0].target_from_object.translation
    assert float(apart[:2].norm()) > 0.2
    assert abs(float(apart[2])) < 0.05
    assert torch.equal(objects[1].target_from_object.rotation, objects[0].target_from_object.rotation)
