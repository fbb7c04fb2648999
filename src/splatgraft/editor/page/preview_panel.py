"""The panel with true pictures beside the live splats: two kinds, a slider between them, the target's cameras.

Knows nothing about how pictures are made.
"""

from __future__ import annotations

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
from splatgraft.editor.page.scene_view import view_of
from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker
from splatgraft.editor.previews.preview import KINDS, NEEDS_LIGHT, Kind, Size, wiped
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.session import Session
from splatgraft.runtime.memo import same_inputs

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page


_SELECTING: tuple[Kind, Kind] = ("Source", "Object alone")
_AT_ONCE = 0.8
"""Seconds that a draft of the light may take without anything else being shown first."""
_LEAST_ASPECT = 1.2
"""Width over height: between two panels a window is narrow, and its picture would be taller than the screen."""


@dataclass(frozen=True)
class _Wish:
    session: Session
    state: EditState
    camera: Cameras
    left: Kind
    right: Kind
    share: float
    moving: bool
    """Something is being dragged: a draft will do."""
    draft: bool = False


class PreviewPanel:
    """Asks for pictures and shows them; the newest wish counts."""

    def __init__(self, page: Page) -> None:
        """Build the panel."""
        self._page, gui = page, page.gui
        self._size = Size()
        self._drawn: dict[Kind, tuple[tuple[object, ...], np.ndarray]] = {}
        self._moving: EditState | None = None
        self._draft_took, self._rest_took = float("inf"), 0.0
        self._latest = LatestOnlyWorker(self._work, lambda error: self._say(" ".join(str(error).split())))
        self._panel = gui.add_panel()
        with self._panel.add_tab("True picture", viser.Icon.PHOTO):
            self._image = gui.add_image(np.full((270, 400, 3), 40, np.uint8), format="jpeg", jpeg_quality=88)
            self._caption = gui.add_html("")
            self._left = gui.add_dropdown("Left", KINDS, initial_value="Copy-paste")
            self._right = gui.add_dropdown("Right", KINDS, initial_value="Light transfer")
            self._share = gui.add_slider("Compare", 0.0, 1.0, 0.01, 0.5)
            self._number = gui.add_slider("Camera", 0, 1, 1, 0, hint="Step through the target's cameras")
            self._follow = gui.add_checkbox("Follow my view", True, hint="Else the picture stays at the camera")
            self._frusta = gui.add_checkbox("Show the cameras", False)
        self._panel.dock_left()
        self._panel.set_width(400)
        for control in (self._left, self._right, self._share, self._follow):
            control.on_update(lambda event: self.ask() if event.client is not None else None)
        self._frusta.on_update(page.act(lambda _: self._show_cameras()))
        self._number.on_update(page.act(lambda _: self._to_camera()))
        self._previous = gui.add_command("Previous camera", hotkey="arrowleft")
        self._next = gui.add_command("Next camera", hotkey="arrowright")
        self._previous.on_trigger(page.act(lambda _: self._step(-1)))
        self._next.on_trigger(page.act(lambda _: self._step(1)))

    def reset(self) -> None:
        """Another project: nothing drawn yet."""
        self._drawn, self._draft_took = {}, float("inf")

    def world_changed(self) -> None:
        """Another scene is shown: its cameras count, and in the source there is one thing to compare."""
        self._left.visible = self._right.visible = self._page.phase != "Select"
        self._number.value = 0
        self._drawn = {}
        self._show_cameras()

    def close(self) -> None:
        """End the thread."""
        self._latest.close()

    def first_camera(self) -> Cameras | None:
        """The camera to begin at, of the scene that the phase shows."""
        cameras = self._cameras()
        return None if cameras is None else cameras[0]

    def moving(self, state: EditState | None) -> None:
        """What counts while something is dragged; None: what is saved."""
        self._moving = state
        self.ask()

    def camera_moved(self, window: int) -> None:
        """A window's view changed."""
        if window == self._page.guarded.seat.holder and self._follow.value:
            self.ask()

    def show(self, left: Kind, right: Kind) -> None:
        """Compare these two."""
        self._left.value, self._right.value = left, right
        self.ask()

    def ask(self) -> None:
        """Draw what counts now, as soon as there is time."""
        wish = self._wish()
        self._panel.visible = wish is not None
        if wish is not None:
            self._latest.ask(wish)

    def save_picture(self, path: Path) -> None:
        """Write the right picture at its camera's full size.

        Raises: ValueError where there is nothing to draw.
        """
        wish = self._wish(width=1280)
        if wish is None:
            raise ValueError("picture: expected a target scene and an open window, found none")
        pixels = wish.session.preview.picture(wish.right, wish.state, wish.camera)
        write_image(path, torch.from_numpy(pixels.astype(np.float32) / 255))

    def _wish(self, *, width: int | None = None) -> _Wish | None:
        session, window = self._page.session, self._page.window()
        if session is None or not self._scene(session).is_file():
            return None
        cameras = self._cameras()
        if cameras is None:
            return None
        if self._number.max != max(1, len(cameras) - 1):
            self._number.max = max(1, len(cameras) - 1)
        if self._follow.value and window is not None:
            camera = view_of(window.camera, width=width or self._size.width, least_aspect=_LEAST_ASPECT)
        else:
            camera = cameras[int(self._number.value)]
            camera = camera.resized((width or self._size.width) / camera.width)
        left, right = _SELECTING if self._page.phase == "Select" else (self._left.value, self._right.value)
        state = self._moving or session.placed_state()
        return _Wish(session, state, camera, left, right, float(self._share.value), self._moving is not None)

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
        self._page.view.cameras(self._cameras() if self._frusta.value else None, size=0.08 * self._page.reach())

    def _to_camera(self) -> None:
        cameras = self._cameras()
        if cameras is not None:
            self._follow.value = False
            self._page.look_through(cameras[min(int(self._number.value), len(cameras) - 1)])

    def _step(self, by: int) -> None:
        cameras = self._cameras()
        if cameras is not None:
            self._number.value = (int(self._number.value) + by) % len(cameras)
            self._to_camera()

    def _work(self, wish: _Wish) -> None:
        transfers = wish.session.transfers
        if not {wish.left, wish.right} & set(NEEDS_LIGHT) or transfers.is_lit(wish.state):
            self._draw(wish, note="")
            return
        if self._draft_took > _AT_ONCE:
            # what is quick comes at once, the light when it is there
            quick = replace(wish, **{side: _quick(getattr(wish, side)) for side in ("left", "right")})
            self._draw(quick, note="light: at work ...")
            if self._latest.overtaken:
                return
        start = time.monotonic()
        transfers.drafted(wish.state)
        self._draft_took = time.monotonic() - start
        self._draw(replace(wish, draft=True), note=f"a draft of the light in {self._draft_took:.1f} s")
        if wish.moving or not self._latest.idle(min(1.5, 0.3 * self._rest_took)):
            return
        start = time.monotonic()
        transfers.relit(wish.state)
        self._rest_took = time.monotonic() - start
        self._draw(wish, note=f"light in {self._rest_took:.1f} s")
        self._page.light_found()

    def _draw(self, wish: _Wish, *, note: str) -> None:
        start = time.monotonic()
        problems: list[str] = []
        left, right = (self._picture(kind, wish, problems) for kind in (wish.left, wish.right))
        spent = (time.monotonic() - start) / 2
        self._image.image = wiped(left, right, wish.share)
        self._size = replace(self._size, width=self._size.after(spent))
        height, width = left.shape[:2]
        files, shown = wish.session.files, (wish.left, wish.right)
        notes = [note, wish.session.transfers.note() if "Light transfer" in shown else ""]
        if "Photograph" in shown and files.pictured[1]:
            notes.append("no photograph: a picture made of the scene, which came without any")
        self._say(
            " &middot; ".join([f"{wish.left} | {wish.right}", f"{width} x {height}", *filter(None, notes), *problems])
        )

    def _picture(self, kind: Kind, wish: _Wish, problems: list[str]) -> np.ndarray:
        camera = wish.camera
        pose = (camera.world_from_camera.numpy().tobytes(), camera.intrinsics.numpy().tobytes())
        state, result = wish.state, wish.session.files.result
        stamp = result.stat().st_mtime_ns if result.is_file() else 0
        objects, selection = state.objects, wish.session.selection() if self._page.phase == "Select" else None
        key = (*pose, wish.draft, stamp, objects, state.erased, state.light, state.weights, selection)
        drawn = self._drawn.get(kind)
        if drawn is None or not same_inputs(drawn[0], key):
            try:
                drawn = (key, self._pixels(kind, wish, selection))
            except ValueError as error:
                problems.append(str(error))
                return np.full((camera.height, camera.width, 3), 48, np.uint8)
            self._drawn[kind] = drawn
        return drawn[1]

    def _pixels(self, kind: Kind, wish: _Wish, selection: Tensor | None) -> np.ndarray:
        preview = wish.session.preview
        if kind in _SELECTING:
            return preview.source_picture(selection if kind == "Object alone" else None, wish.camera)
        return preview.picture(kind, wish.state, wish.camera, draft=wish.draft)

    def _say(self, text: str) -> None:
        self._caption.content = (
            f'<div class="sg-caption" style="font-size:.78em;opacity:.75;padding:0 12px">{text}</div>'
        )


def _quick(kind: Kind) -> Kind:
    return "Copy-paste" if kind in NEEDS_LIGHT else kind
