"""A photo of the source on the canvas, in which clicks say what is the object and what is not."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import viser

from splatgraft.core.images import read_upright
from splatgraft.core.posed_images import PosedImages
from splatgraft.editor.page.canvas import Canvas
from splatgraft.editor.session.photo_points import PhotoView, prompt_of, with_click

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_STYLE = "font-size:.85em;line-height:1.5;padding:2px 12px"
_KINDS = ("on the object", "beside it")
_LONGEST_PX = 1920
"""Of a photo on the canvas; the browser enlarges it on a larger one."""
_TAKES_POINTS = (None, "auto", "grabcut", "sam2")
"""Values of `mask_source` of which the points count."""
_OTHER_SHAPE = 0.01
"""Relative change of the canvas's shape after which the photo is drawn again."""


class PhotoClicks:
    """The controls, and the photo in the window that edits."""

    def __init__(self, page: Page) -> None:
        """Build the controls in the current folder of the panel."""
        self._page, gui = page, page.gui
        with gui.add_folder("Points in photos", expand_by_default=False):
            self._show = gui.add_checkbox("Show a photo", False, hint="Click into it; a click on a point removes it")
            self._kind = gui.add_dropdown("A click is", _KINDS, initial_value=_KINDS[0])
            self._number = gui.add_slider("Photo", 1, 2, 1, 1)
            self._note = gui.add_html("")
            self._clear = gui.add_button("Clear all points", icon=viser.Icon.ERASER, color="gray")
        self._canvas = Canvas(page.server, page.view)
        self._view: PhotoView | None = None
        self._window: int | None = None
        self._photo: tuple[object, np.ndarray, tuple[int, int]] | None = None
        self._show.on_update(page.callback(lambda _: self._say()))
        for control in (self._kind, self._number):
            control.on_update(page.callback(lambda _: None))
        self._clear.on_click(page.callback(lambda _: self._remove_all()))
        page.windows.on_moved.append(self._moved)

    @property
    def is_shown(self) -> bool:
        """Whether the canvas shows a photo."""
        return self._view is not None

    def leave(self) -> None:
        """Show the scene again."""
        if self._view is not None:
            self._page.server.scene.remove_click_callback(self._clicked)
            self._view = None
            self._canvas.clear()

    def refresh(self) -> None:
        """Update the controls, and show the photo where that is wanted."""
        session, window = self._page.require_session(), self._page.windows.editing()
        self._clear.disabled = session.state.prompts is None
        if not self._show.value or window is None or not session.files.source_cameras.is_file():
            self.leave()
            self._note.content = _line(self._count())
            return
        capture = session.scenes.capture(session.files.source_cameras)
        if self._number.max != max(2, len(capture)):
            self._number.max = max(2, len(capture))
        index = self._index(capture)
        pixels, size = self._pixels(capture, index)
        name = capture.cameras.names[index]
        aspect = window.camera.aspect if window.camera.aspect > 0 else 1.5
        width = min(_LONGEST_PX, max(256, window.camera.image_width))
        view = PhotoView(size, (width, max(16, round(width / aspect))))
        if self._view is None:
            self._page.server.scene.on_click()(self._clicked)
        self._view, self._window = view, window.client_id
        self._canvas.show(window, view.drawn(pixels, prompt_of(session.state.prompts, name)), None)
        self._note.content = _line(f"{html.escape(name)}<br>{self._count()}")

    def _index(self, capture: PosedImages) -> int:
        return min(int(self._number.value), len(capture)) - 1

    def _pixels(self, capture: PosedImages, index: int) -> tuple[np.ndarray, tuple[int, int]]:
        path = capture.image_paths[index]
        key = (path, path.stat().st_mtime_ns if path.is_file() else 0)
        if self._photo is None or self._photo[0] != key:
            self._photo = (key, *read_upright(path, _LONGEST_PX))
        return self._photo[1], self._photo[2]

    def _count(self) -> str:
        prompts = self._page.require_session().state.prompts or {}
        inside, outside = (sum(len(getattr(p, kind)) for p in prompts.values()) for kind in ("inside", "outside"))
        if not prompts:
            return "No points yet; some in two or three photos are usually enough."
        where = "1 photo" if len(prompts) == 1 else f"{len(prompts)} photos"
        return f"<b>{inside}</b> on the object, <b>{outside}</b> beside it, in {where}"

    def _say(self) -> None:
        if self._show.value:
            self._page.say("click on the object and beside it in two or three photos, then cut it out")

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._page.callback(self._add)(event)

    def _add(self, event: viser.SceneClickEvent) -> None:
        session, view = self._page.require_session(), self._view
        if view is None or event.client_id != self._window:
            return
        pixel = view.pixel_at(event.screen_pos)
        if pixel is None:
            self._page.say("that was beside the photo")
            return
        capture = session.scenes.capture(session.files.source_cameras)
        name, on_object = capture.cameras.names[self._index(capture)], self._kind.value == _KINDS[0]
        prompts = with_click(session.state.prompts, name, pixel, on_object=on_object, longer_side=max(view.photo))
        state, takes = replace(session.state, prompts=prompts), session.state.mask_source in _TAKES_POINTS
        session.change(state if takes else replace(state, mask_source="auto"))
        note = "" if takes else "; masks are cut by the points now"
        self._page.say(f"points in {name}: {self._counts(name)}{note}")

    def _counts(self, name: str) -> str:
        prompt = prompt_of(self._page.require_session().state.prompts, name)
        return f"{len(prompt.inside)} on the object, {len(prompt.outside)} beside it"

    def _remove_all(self) -> None:
        session = self._page.require_session()
        session.change(replace(session.state, prompts=None))

    def _moved(self, window: int) -> None:
        """Draw the photo again where the window's shape has changed."""
        view, editing = self._view, self._page.windows.editing()
        if view is None or editing is None or window != editing.client_id:
            return
        shape = view.canvas[0] / view.canvas[1]
        if window != self._window or abs(editing.camera.aspect / shape - 1) > _OTHER_SHAPE:
            self._page.callback(lambda _: None)(None)


def _line(text: str) -> str:
    return f'<div class="sg-photo" style="{_STYLE}">{text}</div>'
