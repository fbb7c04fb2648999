"""The preview panel: two preview images with a slider between them, and navigation through the cameras."""

from __future__ import annotations

import html
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import viser
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import write_image
from splatgraft.editor.page.scene_view import camera_from_viser
from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker
from splatgraft.editor.previews.preview import NEEDS_LIGHT, PICTURE_KINDS, PictureKind, PictureSize, wipe_comparison
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.session import Session
from splatgraft.runtime.memo import Memo

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page


_SOURCE_KINDS: tuple[PictureKind, PictureKind] = ("Source", "Object alone")
_DRAFT_LIMIT = 0.8
"""Seconds; where drafts of the light take longer, images without the light transfer are shown first."""
_MIN_ASPECT = 1.2
"""Minimum width over height: between two panels a window is narrow, and its image would exceed the panel."""


@dataclass(frozen=True)
class _PictureRequest:
    """What the worker is to draw."""

    session: Session
    state: EditState
    camera: Cameras
    left: PictureKind
    right: PictureKind
    split: float
    is_dragging: bool
    """Whether something is being dragged; then a draft suffices."""
    draft: bool = False


class PreviewPanel:
    """Renders previews in a worker thread and shows them; only the newest request is rendered."""

    def __init__(self, page: Page) -> None:
        """Build the panel."""
        self._page, gui = page, page.gui
        self._size = PictureSize()
        self._pictures = Memo()
        self._dragged_state: EditState | None = None
        self._draft_seconds, self._relight_seconds = float("inf"), 0.0
        self._worker = LatestOnlyWorker(self._work, lambda error: self._say(" ".join(str(error).split())))
        self._panel = gui.add_panel()
        with self._panel.add_tab("Preview", viser.Icon.PHOTO):
            self._image = gui.add_image(np.full((270, 400, 3), 40, np.uint8), format="jpeg", jpeg_quality=88)
            self._caption = gui.add_html("")
            self._left = gui.add_dropdown("Left", PICTURE_KINDS, initial_value="Copy-paste")
            self._right = gui.add_dropdown("Right", PICTURE_KINDS, initial_value="Light transfer")
            self._split = gui.add_slider("Compare", 0.0, 1.0, 0.01, 0.5)
            self._camera_slider = gui.add_slider("Camera", 0, 1, 1, 0, hint="Step through the target's cameras")
            self._follow = gui.add_checkbox("Follow my view", True, hint="Otherwise the preview stays at the camera")
            self._frusta = gui.add_checkbox("Show the cameras", False)
        self._panel.dock_left()
        self._panel.set_width(400)
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
        self._pictures, self._draft_seconds = Memo(), float("inf")

    def scene_changed(self) -> None:
        """Switch to the cameras of the other scene; the source has only one pair of images."""
        self._left.visible = self._right.visible = self._page.phase != "Select"
        self._camera_slider.value = 0
        self._pictures = Memo()
        self._show_cameras()

    def close(self) -> None:
        """End the worker thread."""
        self._worker.close()

    def first_camera(self) -> Cameras | None:
        """The first camera of the scene that the phase shows; None where there is none."""
        cameras = self._cameras()
        return None if cameras is None else cameras[0]

    def set_dragged_state(self, state: EditState | None) -> None:
        """Show `state` during a drag; None: show the saved state."""
        self._dragged_state = state
        self.update()

    def camera_moved(self, window: int) -> None:
        """Update the preview after a window's view changed."""
        if window == self._page.guarded.edit_lock.holder and self._follow.value:
            self.update()

    def show(self, left: PictureKind, right: PictureKind) -> None:
        """Select the two kinds of images."""
        self._left.value, self._right.value = left, right
        self.update()

    def update(self) -> None:
        """Request a preview of the current state."""
        request = self._request()
        self._panel.visible = request is not None
        if request is not None:
            self._worker.submit(request)

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

    def _request(self, *, width: int | None = None) -> _PictureRequest | None:
        session, window = self._page.session, self._page.windows.editing()
        if session is None or not self._scene(session).is_file():
            return None
        cameras = self._cameras()
        if cameras is None:
            return None
        if self._camera_slider.max != max(1, len(cameras) - 1):
            self._camera_slider.max = max(1, len(cameras) - 1)
        if self._follow.value and window is not None:
            camera = camera_from_viser(window.camera, width=width or self._size.width, min_aspect=_MIN_ASPECT)
        else:
            camera = cameras[int(self._camera_slider.value)]
            camera = camera.resized((width or self._size.width) / camera.width)
        left, right = _SOURCE_KINDS if self._page.phase == "Select" else (self._left.value, self._right.value)
        state = self._dragged_state or session.placed_state()
        return _PictureRequest(
            session, state, camera, left, right, float(self._split.value), self._dragged_state is not None
        )

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

    def _work(self, request: _PictureRequest) -> None:
        relighting = request.session.relighting
        if not {request.left, request.right} & set(NEEDS_LIGHT) or relighting.is_relit(request.state):
            self._draw(request, note="")
            return
        if self._draft_seconds > _DRAFT_LIMIT:
            # first the images that need no light transfer
            fast = replace(request, **{side: _without_light(getattr(request, side)) for side in ("left", "right")})
            self._draw(fast, note="light: computing ...")
            if self._worker.superseded:
                return
        start = time.monotonic()
        relighting.draft(request.state)
        self._draft_seconds = time.monotonic() - start
        self._draw(replace(request, draft=True), note=f"a draft of the light in {self._draft_seconds:.1f} s")
        if request.is_dragging or not self._worker.wait_idle(min(1.5, 0.3 * self._relight_seconds)):
            return
        start = time.monotonic()
        relighting.relit(request.state)
        self._relight_seconds = time.monotonic() - start
        self._draw(request, note=f"light in {self._relight_seconds:.1f} s")
        self._page.light_ready()

    def _draw(self, request: _PictureRequest, *, note: str) -> None:
        start = time.monotonic()
        problems: list[str] = []
        left, right = (self._picture(kind, request, problems) for kind in (request.left, request.right))
        seconds = (time.monotonic() - start) / 2
        self._image.image = wipe_comparison(left, right, request.split)
        self._size = replace(self._size, width=self._size.adapted(seconds))
        height, width = left.shape[:2]
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

    def _picture(self, kind: PictureKind, request: _PictureRequest, problems: list[str]) -> np.ndarray:
        camera = request.camera
        pose = (camera.world_from_camera.numpy().tobytes(), camera.intrinsics.numpy().tobytes())
        state, result = request.state, request.session.files.result
        stamp = result.stat().st_mtime_ns if result.is_file() else 0
        objects, selection = state.objects, request.session.selection() if self._page.phase == "Select" else None
        key = (*pose, request.draft, stamp, objects, state.erased, state.light, state.weights, selection)
        try:
            return self._pictures.get(kind, key, lambda: self._pixels(kind, request, selection))
        except ValueError as error:
            problems.append(str(error))
            return np.full((camera.height, camera.width, 3), 48, np.uint8)

    def _pixels(self, kind: PictureKind, request: _PictureRequest, selection: Tensor | None) -> np.ndarray:
        preview = request.session.preview
        if kind in _SOURCE_KINDS:
            return preview.source_picture(selection if kind == "Object alone" else None, request.camera)
        return preview.picture(kind, request.state, request.camera, draft=request.draft)

    def _say(self, text: str) -> None:
        self._caption.content = (
            f'<div class="sg-caption" style="font-size:.78em;opacity:.75;padding:0 12px">{text}</div>'
        )


def _without_light(kind: PictureKind) -> PictureKind:
    return "Copy-paste" if kind in NEEDS_LIGHT else kind
