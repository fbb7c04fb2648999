"""The preview panel: two preview images with a slider between them, and navigation through the cameras."""

from __future__ import annotations

import html
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import viser

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import write_image
from splatgraft.editor.page.canvas import Canvas, depth_behind
from splatgraft.editor.page.picture_request import SOURCE_KINDS, PictureRequest, pose_of
from splatgraft.editor.page.request_pictures import RequestPictures
from splatgraft.editor.page.saved_preview import save_preview
from splatgraft.editor.page.scene_view import camera_from_viser
from splatgraft.editor.page.watcher_pictures import WatcherPictures
from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker
from splatgraft.editor.previews.preview import (
    NEEDS_LIGHT,
    PICTURE_KINDS,
    PictureKind,
    PictureSize,
    wipe_comparison,
    with_badge,
)
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.session import Session

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page


_DRAFT_LIMIT = 1.5
"""Seconds; where drafts of the light take longer, images without the light transfer are shown first."""
_REST_SECONDS = 0.1
"""How long the camera stands still before its picture is drawn; browsers report a moving one more often."""
_COARSE_ABOVE = 0.4
"""Seconds; a picture that takes longer is preceded by a coarse one."""
_COARSE_SHARE, _COARSE_BUDGET = 0.5, 120_000
"""Size of a coarse picture over the canvas's, and its number of Gaussians."""
_MAX_WIDTH = 1920
"""Pixels; pictures of larger canvases are enlarged by the browser."""
_MIN_ASPECT = 1.2
"""Minimum width over height of the picture in the panel."""


class PreviewPanel:
    """Renders pictures in a worker thread, for the canvas or for the panel; only the newest request is rendered."""

    def __init__(self, page: Page) -> None:
        """Build the panel."""
        self._page, gui = page, page.gui
        self._size = PictureSize()
        self._pictures = RequestPictures()
        self._dragged_state: EditState | None = None
        self._draft_seconds, self._relight_seconds, self._picture_seconds = float("inf"), 0.0, 0.0
        self._light_note = ""
        self.canvas = Canvas(page.server, page.view)
        self._watchers = WatcherPictures(page)
        self._shown_pose: bytes = b""
        self._canvas_size: tuple[float, int] = (0.0, 0)
        self._is_on_canvas = False
        """Whether the newest request is for the canvas."""
        self.on_drawn: Callable[[str, float], None] = lambda stage, seconds: None
        """Called with `coarse`, `draft` or `final` and the seconds that the picture took; for measurements."""
        self._worker = LatestOnlyWorker(self._work, self._say_error)
        self._light_worker = LatestOnlyWorker(self._compute_light, self._say_error)
        self._panel = gui.add_folder("View")
        with self._panel:
            self._image = gui.add_image(np.full((270, 400, 3), 40, np.uint8), format="jpeg", jpeg_quality=88)
            self._caption = gui.add_html("")
            self._right = gui.add_dropdown("Picture", PICTURE_KINDS, initial_value="Light transfer")
            self._left = gui.add_dropdown("Compare with", PICTURE_KINDS, initial_value="Copy-paste")
            self._split = gui.add_slider(
                "Compare", 0.0, 1.0, 0.01, 0.0, hint="How much of the width shows what it is compared with"
            )
            self._camera_slider = gui.add_slider("Camera", 0, 1, 1, 0, hint="Step through the target's cameras")
            self._follow = gui.add_checkbox(
                "Draw on the canvas", True, hint="Otherwise the canvas shows splats, and the panel the camera's picture"
            )
            self._frusta = gui.add_checkbox("Show the cameras", False)
        for control in (self._left, self._right, self._split, self._follow):
            control.on_update(lambda event: self.update() if event.client is not None else None)
        self._frusta.on_update(page.callback(lambda _: self._show_cameras()))
        self._camera_slider.on_update(page.callback(lambda _: self._to_camera()))
        self._previous = gui.add_command("Previous camera", hotkey="arrowleft")
        self._next = gui.add_command("Next camera", hotkey="arrowright")
        self._previous.on_trigger(page.callback(lambda _: self._step(-1)))
        self._next.on_trigger(page.callback(lambda _: self._step(1)))

    def reset(self) -> None:
        """Discard cached images and timings for another project."""
        self.canvas.clear()
        self._watchers.forget()
        self._pictures.forget()
        self._draft_seconds = float("inf")

    def scene_changed(self) -> None:
        """Switch to the cameras of the other scene; the source has only one pair of images."""
        self._left.visible = self._right.visible = self._page.phase != "Select"
        self._camera_slider.value = 0
        self._pictures.forget()
        self._show_cameras()

    def close(self) -> None:
        """End the worker threads."""
        self._worker.close()
        self._light_worker.close()
        self._watchers.close()

    def first_camera(self) -> Cameras | None:
        """The first camera of the scene that the phase shows; None where there is none."""
        cameras = self._cameras()
        return None if cameras is None else cameras[0]

    def set_dragged_state(self, state: EditState | None) -> None:
        """Show `state` during a drag; None: show the saved state."""
        self._dragged_state = state
        self.update()

    def camera_moved(self, window: int) -> None:
        """Show splats while a window's view moves, and its picture when it rests."""
        if window != self._page.guarded.edit_lock.holder:
            self._watchers.camera_moved(window)
        elif self._follow.value:
            self._submit(is_moved=True)

    def show(self, left: PictureKind, right: PictureKind) -> None:
        """Select the two kinds of images."""
        self._left.value, self._right.value = left, right
        self.update()

    def holder_changed(self) -> None:
        """Show the picture in the window that edits now."""
        self.canvas.clear()
        self._watchers.clear()
        self.update()

    def update(self) -> None:
        """Request a preview of the current state."""
        self._submit(is_moved=False)

    def _submit(self, *, is_moved: bool) -> None:
        request = self._request()
        self._panel.visible = request is not None
        self._image.visible = request is not None and request.window is None
        self._is_on_canvas = request is not None and request.window is not None
        if request is None or request.window is None or (is_moved and pose_of(request.camera) != self._shown_pose):
            self.canvas.clear()
        if request is None or request.window is None or request.is_dragging:
            self._watchers.clear()
        if request is not None:
            self._worker.submit(replace(request, is_moved=is_moved))

    def save_picture(self, path: Path) -> None:
        """Write the right image, 1280 pixels wide.

        Raises:
            ValueError: If there is no target scene.
        """
        request = self._request(width=1280)
        if request is None:
            raise ValueError("picture: expected a reconstructed scene with cameras, found none")
        pixels = request.session.preview.picture(request.right, request.state, request.camera)
        write_image(path, torch.from_numpy(pixels.astype(np.float32) / 255))

    def _request(self, *, width: int | None = None) -> PictureRequest | None:
        session, window = self._page.session, self._page.windows.editing()
        if session is None or not self._scene(session).is_file():
            return None
        cameras = self._cameras()
        if cameras is None:
            return None
        if self._camera_slider.max != max(1, len(cameras) - 1):
            self._camera_slider.max = max(1, len(cameras) - 1)
        is_on_canvas = self._follow.value and window is not None and self._page.phase != "Select"
        if window is not None and self._follow.value:
            size = self._canvas_width(window) if is_on_canvas else self._size.width
            aspect = 0.0 if is_on_canvas else _MIN_ASPECT
            camera = camera_from_viser(window.camera, width=width or size, min_aspect=aspect)
        else:
            camera = cameras[int(self._camera_slider.value)]
            camera = camera.resized((width or self._size.width) / camera.width)
        left, right = SOURCE_KINDS if self._page.phase == "Select" else (self._left.value, self._right.value)
        return PictureRequest(
            session=session,
            state=self._dragged_state or session.placed_state(),
            camera=camera,
            left=left,
            right=right,
            split=float(self._split.value),
            window=window if is_on_canvas else None,
            is_dragging=self._dragged_state is not None,
        )

    def _canvas_width(self, window: viser.ClientHandle) -> int:
        """Width of the canvas; a slow browser reduces its own while the view moves."""
        aspect, width = round(window.camera.aspect, 2), window.camera.image_width
        if aspect != self._canvas_size[0]:
            self._canvas_size = (aspect, 0)
        self._canvas_size = (aspect, max(width, self._canvas_size[1]))
        return min(_MAX_WIDTH, max(64, self._canvas_size[1]))

    def _scene(self, session: Session) -> Path:
        return session.files.source_scene if self._page.phase == "Select" else session.files.target_scene

    def _cameras(self) -> Cameras | None:
        session = self._page.session
        if session is None:
            return None
        files = session.files
        path = files.source_cameras if self._page.phase == "Select" else files.target_cameras
        return session.scenes.cameras(path) if path.is_file() else None

    def _show_cameras(self) -> None:
        self._page.view.show_cameras(
            self._cameras() if self._frusta.value else None, size=0.08 * self._page.scene_scale()
        )

    def _to_camera(self) -> None:
        cameras = self._cameras()
        if cameras is not None:
            self._follow.value = False
            self._page.windows.look_through(cameras[min(int(self._camera_slider.value), len(cameras) - 1)])

    def _step(self, by: int) -> None:
        cameras = self._cameras()
        if cameras is not None:
            self._camera_slider.value = (int(self._camera_slider.value) + by) % len(cameras)
            self._to_camera()

    def _work(self, request: PictureRequest) -> None:
        if request.is_moved and not self._worker.wait_idle(_REST_SECONDS):
            return
        relighting, state = request.session.relighting, request.state
        if not self._page.loading.has(request.session, request.scenes()):
            # drawn again when the scenes are there
            self._draw_once(
                replace(request.without_light(), is_sample=True), note="the scene is being read", stage="coarse"
            )
            return
        if not {request.left, request.right} & set(NEEDS_LIGHT) or relighting.is_relit(state):
            self._draw(request, note=self._light_note)
            return
        if self._draft_seconds > _DRAFT_LIMIT and not relighting.has_draft(state):
            # first the images that need no light transfer
            self._draw(request.without_light(), note="light: computing ...", stage="copy-paste")
            if self._worker.superseded:
                return
        start = time.monotonic()
        if not relighting.has_draft(state):
            relighting.draft(state)
            self._draft_seconds = time.monotonic() - start
        self._draw(replace(request, draft=True), note=f"a draft of the light in {self._draft_seconds:.1f} s")
        if not request.is_dragging:
            self._light_worker.submit(request)

    def _compute_light(self, request: PictureRequest) -> None:
        """The light as the step computes it, when nothing has changed for a moment."""
        relighting = request.session.relighting
        if relighting.is_relit(request.state) or not self._light_worker.wait_idle(
            min(1.5, 0.3 * self._relight_seconds)
        ):
            return
        if relighting.can_refine(request.state) and not relighting.is_refined(request.state):
            relighting.refined(request.state)
            if not self._light_worker.closed:
                self.update()  # once drawn, asks for the light itself
            return
        start = time.monotonic()
        relighting.relit(request.state)
        if self._light_worker.closed:
            return
        self._relight_seconds = time.monotonic() - start
        self._light_note = f"light in {self._relight_seconds:.1f} s"
        self._page.light_ready()
        self.update()
        if self._light_worker.wait_idle(_REST_SECONDS):
            relighting.prepare_drafts(request.state)

    def _draw(self, request: PictureRequest, *, note: str, stage: str = "") -> None:
        stage = stage or ("draft" if request.draft else "final")
        if request.window is not None and self._picture_seconds > _COARSE_ABOVE:
            camera = request.camera.resized(_COARSE_SHARE)
            self._draw_once(replace(request, camera=camera, budget=_COARSE_BUDGET), note=note, stage="coarse")
            if self._worker.superseded:
                return
        self._draw_once(request, note=note, stage=stage)

    def _draw_once(self, request: PictureRequest, *, note: str, stage: str) -> None:
        start = time.monotonic()
        problems: list[str] = []
        left, right = self._pictures.both(request, problems)
        seconds = time.monotonic() - start
        pixels = wipe_comparison(left.pixels, right.pixels, request.split)
        # the page was closed, or the canvas given to splats, while this picture was drawn
        if self._worker.closed or (request.window is not None and not self._is_on_canvas):
            return
        if request.window is not None:
            depth = right.depth if request.split < 0.5 else left.depth
            self.canvas.show(request.window, with_badge(pixels, stage), depth_behind(depth))
            self._shown_pose = pose_of(request.camera)
            self._picture_seconds = seconds if stage != "coarse" else self._picture_seconds
            if stage != "coarse":
                self._watchers.editing_window_shows(request, stage)
            if stage == "final":
                save_preview(request.session.files.root, right.pixels)
        else:
            self._image.image = pixels
            self._size = replace(self._size, width=self._size.adapted(seconds / 2))
        self.on_drawn(stage, time.monotonic() - start)
        height, width = left.pixels.shape[:2]
        files, shown = request.session.files, (request.left, request.right)
        notes = [note, request.session.relighting.light_mode_note() if "Light transfer" in shown else ""]
        if "Photograph" in shown and files.without_photos[1]:
            notes.append("no photograph: an image rendered of the scene, which has no photographs")
        why = request.session.why_stale("consolidate") if "Result" in shown and files.result.is_file() else None
        if why is not None:
            notes.append(f"<b>the result is out of date</b> ({html.escape(why)}): see Run")
        self._say(
            " &middot; ".join(
                [f"{request.left} | {request.right}", f"{width} x {height}", *filter(None, notes), *problems]
            )
        )

    def _say_error(self, error: Exception) -> None:
        traceback.print_exception(error)
        self._say(" ".join(str(error).split()))

    def _say(self, text: str) -> None:
        self._caption.content = (
            f'<div class="sg-caption" style="font-size:.78em;opacity:.75;padding:0 12px">{text}</div>'
        )
