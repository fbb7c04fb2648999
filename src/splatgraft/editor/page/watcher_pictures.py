"""Pictures by splatgraft's renderer in the windows that watch: what the editing one shows, from their own views."""

from __future__ import annotations

import threading
import traceback
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import viser

from splatgraft.editor.page.canvas import Canvas, depth_behind
from splatgraft.editor.page.picture_request import PictureRequest
from splatgraft.editor.page.request_pictures import RequestPictures, picture_key
from splatgraft.editor.page.scene_view import camera_from_viser
from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker
from splatgraft.editor.previews.preview import wipe_comparison, with_badge
from splatgraft.runtime.memo import same_inputs

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_REST_SECONDS = 0.3
"""How long no view moves and the editing window gets no new picture before watchers get theirs."""
_MAX_WIDTH = 960
"""Pixels; the renderer serves one picture at a time, and the editing window must not wait long for it."""


@dataclass(frozen=True)
class _Shown:
    """The request whose pictures the editing window shows, and the word in its corner."""

    request: PictureRequest
    stage: str


class WatcherPictures:
    """One canvas per watching window; its splats are shown while its view or the object moves."""

    def __init__(self, page: Page) -> None:
        """Start without pictures."""
        self._page = page
        self._canvases: dict[int, Canvas] = {}
        self._keys: dict[int, tuple[object, ...]] = {}
        self._lock = threading.RLock()
        self._shown: _Shown | None = None
        self._pictures = RequestPictures()
        self._worker = LatestOnlyWorker(self._draw_all, traceback.print_exception)

    def editing_window_shows(self, request: PictureRequest, stage: str) -> None:
        """Draw the same for all watchers when nothing moves any more.

        Args:
            request: What the editing window's canvas shows now.
            stage: `draft`, `final` or what else stands in the corner of its picture.
        """
        if request.is_dragging:
            self.clear()
            return
        self._shown = _Shown(request, stage)
        self._worker.submit(self._shown)

    def camera_moved(self, window: int) -> None:
        """Show splats in a watching window while its view moves, and its picture when it rests."""
        shown, client = self._shown, self._page.server.get_clients().get(window)
        if shown is None or client is None:
            return
        with self._lock:
            if window in self._canvases and not self._has_picture(window, _key(shown, client)):
                self._canvases[window].clear()
                self._keys.pop(window, None)
        self._worker.submit(shown)

    def clear(self) -> None:
        """Show splats in all watching windows until the editing window shows another picture."""
        with self._lock:
            self._shown = None
            for canvas in self._canvases.values():
                canvas.clear()
            self._canvases.clear()
            self._keys.clear()

    def forget(self) -> None:
        """Discard the pictures of a project that is closed."""
        self.clear()
        self._pictures.forget()

    def close(self) -> None:
        """End the worker thread."""
        self._worker.close()

    def _draw_all(self, shown: _Shown) -> None:
        if not self._worker.wait_idle(_REST_SECONDS):
            return
        for window in self._page.windows.watching():
            if self._worker.superseded or self._shown is not shown:
                return
            self._draw(shown, window)

    def _draw(self, shown: _Shown, window: viser.ClientHandle) -> None:
        number, key = window.client_id, _key(shown, window)
        if self._has_picture(number, key):
            return
        request = _seen_from(shown.request, window)
        left, right = self._pictures.both(request, [])
        pixels = wipe_comparison(left.pixels, right.pixels, request.split)
        depth = right.depth if request.split < 0.5 else left.depth
        with self._lock:
            # meanwhile the view may have moved, the window may edit, or the editing window may show something else
            is_watching = number in {one.client_id for one in self._page.windows.watching()}
            if self._shown is not shown or not is_watching or not same_inputs(_key(shown, window), key):
                return
            canvas = self._canvases.setdefault(number, Canvas(self._page.server, self._page.view))
            canvas.show(window, with_badge(pixels, shown.stage), depth_behind(depth))
            self._keys[number] = key

    def _has_picture(self, window: int, key: tuple[object, ...]) -> bool:
        return same_inputs(self._keys.get(window, ()), key)


def _key(shown: _Shown, window: viser.ClientHandle) -> tuple[object, ...]:
    """What a window's picture depends on."""
    request = _seen_from(shown.request, window)
    return (shown.stage, request.left, request.right, request.split, *picture_key(request))


def _seen_from(request: PictureRequest, window: viser.ClientHandle) -> PictureRequest:
    width = min(_MAX_WIDTH, max(64, window.camera.image_width))
    return replace(request, camera=camera_from_viser(window.camera, width=width), window=window, budget=None)
