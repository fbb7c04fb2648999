"""A photo on the canvas, and clicks in it that become points of `segment`."""

from pathlib import Path

import numpy as np
import pytest
from editor_driver import Window, state_of
from PIL import Image
from test_canvas_in_browser import canvas_of
from test_hostile_values import made, project

from splatgraft.editor.session.photo_points import PhotoView
from splatgraft.formats import read_capture

__all__ = ["made", "project"]


def test_clicks_in_a_photo_become_points(window: Window, project: Path) -> None:
    capture = read_capture(project.parent / "source" / "capture")
    photo = Image.open(capture.image_paths[1]).convert("RGB")
    window.show_phase("Select")
    window.unfold("Points in photos")
    window.check("Show a photo")
    window.write("Photo", "2")
    window.says(capture.cameras.names[1])
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
    place = (0.6 * photo.width, 0.4 * photo.height)
    at = (left + view.scale * place[0], top + view.scale * place[1])
    window.act_until(
        lambda: window.page.mouse.click(*at), lambda: state_of(project).prompts is not None, what="a point in the file"
    )
    window.says("1 on the object, 0 beside it")
    prompts = state_of(project).prompts
    assert prompts is not None
    assert list(prompts) == [capture.cameras.names[1]]
    # to a pixel of the window
    assert prompts[capture.cameras.names[1]].inside[0].tolist() == pytest.approx(place, abs=1.5 / view.scale)
    window.page.keyboard.press("Control+z")
    window.until(lambda: state_of(project).prompts is None, what="the click undone")
    window.check("Show a photo", False)
    window.until(lambda: not is_shown(), what="the scene again")
    assert window.unknown_errors() == []
