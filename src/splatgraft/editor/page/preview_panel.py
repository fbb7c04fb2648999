"""The renderer's pictures on the canvas or in the panel: two kinds with a slider between them, and steps through the
cameras."""

import html
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import viser

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import write_image
from splatgraft.editor.memo import Memo
from splatgraft.editor.page.context import VIEW_ORDER, PageContext
from splatgraft.editor.page.scene_view import Canvas, camera_from_viser
from splatgraft.editor.pictures import (
    NEEDS_LIGHT,
    PICTURE_KINDS,
    SOURCE_KINDS,
    Picture,
    PictureKind,
    wipe_comparison,
    with_badge,
)
from splatgraft.editor.session import Session
from splatgraft.editor.state import EditState
from splatgraft.editor.worker import LatestOnlyWorker

_MAX_DRAFT_SECONDS = 1.5
"""Where drafts of the light take longer, pictures without the light transfer are shown first."""
_REST_SECONDS = 0.1
"""How long the camera stands still before its picture is drawn; browsers report a moving one more often."""
_SETTLE_SECONDS = 0.5
"""How long nothing must change before the light itself is computed."""
_COARSE_ABOVE = 0.4
"""Seconds; a picture that takes longer is preceded by a coarse one."""
_COARSE_SHARE, _COARSE_BUDGET = 0.5, 120_000
"""Size of a coarse picture over the canvas's, and its number of Gaussians."""
_PANEL_WIDTH, _MAX_WIDTH, _SAVED_WIDTH = 480, 1920, 1280
"""Pixels of the picture in the panel, of the largest one on the canvas, which the browser enlarges, and of a file."""
_MIN_ASPECT = 1.2
"""Minimum width over height of the picture in the panel."""


@dataclass(frozen=True)
class PictureRequest:
    """What the worker is to draw."""

    session: Session
    state: EditState
    camera: Cameras
    left: PictureKind
    right: PictureKind
    split: float
    window: viser.ClientHandle | None
    """The window whose canvas shows the picture; None: the panel shows it."""
    is_dragging: bool = False
    """Whether something is being dragged; then a draft suffices."""
    is_moved: bool = False
    """Whether the camera has moved; the picture is drawn when it rests."""
    draft: bool = False
    """Whether a draft of the light is drawn."""
    budget: int | None = None
    """Maximum number of Gaussians that are drawn; None: all."""

    @property
    def is_of_source(self) -> bool:
        """Whether the source is drawn."""
        return self.left in SOURCE_KINDS

    def scenes(self) -> tuple[Path, ...]:
        """The files of the scenes that the picture needs."""
        return (self.session.files.source_scene,) if self.is_of_source else self.session.placed_scenes()

    def key(self) -> tuple[object, ...]:
        """What the pictures depend on, other than their kind; requests with equal keys give equal pictures."""
        state, result = self.state, self.session.files.result
        stamp = result.stat().st_mtime_ns if result.is_file() else 0
        best_draft = self.session.relighting.best(state) if self.draft else None
        selection = self.session.selection() if self.is_of_source else None
        drawn = (_pose(self.camera), self.draft, best_draft, self.budget or 0, stamp)
        return (*drawn, state.objects, state.erased, state.light, state.weights, selection)

    def draw(self, kind: PictureKind) -> Picture:
        """Draw one of the pictures; ValueError where a file that it needs does not exist yet."""
        session, pictures = self.session, self.session.pictures
        if self.is_of_source:
            return pictures.source_view(session.selection() if kind == "Object alone" else None, self.camera)
        return pictures.view(kind, self.state, self.camera, draft=self.draft, budget=self.budget)


class PreviewPanel:
    """Renders pictures in a worker thread, for the canvas or for the panel; only the newest request is rendered."""

    def __init__(self, context: PageContext) -> None:
        """Build the panel."""
        self._context, gui = context, context.gui
        self._drawn = Memo()
        self._dragged_state: EditState | None = None
        self._draft_seconds, self._picture_seconds = float("inf"), 0.0
        self._light_note = ""
        self.canvas = Canvas(context.server, context.view)
        self._shown_pose: bytes = b""
        self._canvas_size: tuple[float, int] = (0.0, 0)
        self._is_on_canvas = False
        """Whether the newest request is for the canvas."""
        self.light_ready: Callable[[], None] = lambda: None
        """Called after the light has been estimated."""
        self._worker = LatestOnlyWorker(self._work, self._say_error)
        self._light_worker = LatestOnlyWorker(self._compute_light, self._say_error)
        context.on_close += [self._worker.close, self._light_worker.close]
        self._panel = gui.add_folder("View", order=VIEW_ORDER)
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
            self._frusta = context.on(gui.add_checkbox("Show the cameras", False), self._show_cameras)
        for control in (self._left, self._right, self._split, self._follow):
            control.on_update(lambda event: self.update() if event.client is not None else None)
        context.on(self._camera_slider, self._to_camera)
        context.on(gui.add_command("Previous camera", hotkey="arrowleft"), lambda: self._step(-1))
        context.on(gui.add_command("Next camera", hotkey="arrowright"), lambda: self._step(1))

    def reset(self) -> None:
        """Discard pictures and timings for another project."""
        self.canvas.clear()
        self._drawn = Memo()
        self._draft_seconds = float("inf")

    def scene_changed(self) -> None:
        """Switch to the cameras of the other scene; the source has only one pair of pictures."""
        self._left.visible = self._right.visible = self._context.phase != "Select"
        self._camera_slider.value = 0
        self._drawn = Memo()
        self._show_cameras()

    def set_dragged_state(self, state: EditState | None) -> None:
        """Show `state` during a drag; None: show the saved state."""
        self._dragged_state = state
        self.update()

    def camera_moved(self) -> None:
        """Show splats while the editing window's view moves, and its picture when it rests."""
        if self._follow.value:
            self._submit(is_moved=True)

    def show(self, left: PictureKind, right: PictureKind) -> None:
        """Select the two kinds of pictures."""
        self._left.value, self._right.value = left, right
        self.update()

    def update(self) -> None:
        """Request a picture of the current state."""
        self._submit(is_moved=False)

    def save_picture(self, path: Path) -> None:
        """Write the right picture, 1280 pixels wide."""
        request = self._request(width=_SAVED_WIDTH)
        if request is None:
            raise ValueError("picture: expected a reconstructed scene with cameras, found none")
        pixels = request.draw(request.right).pixels
        write_image(path, torch.from_numpy(pixels.astype(np.float32) / 255))

    # requests

    def _submit(self, *, is_moved: bool) -> None:
        request = self._request()
        self._panel.visible = request is not None
        self._image.visible = request is not None and request.window is None
        self._is_on_canvas = request is not None and request.window is not None
        if request is None or request.window is None or (is_moved and _pose(request.camera) != self._shown_pose):
            self.canvas.clear()
        if request is not None:
            self._worker.submit(replace(request, is_moved=is_moved))

    def _request(self, *, width: int | None = None) -> PictureRequest | None:
        context = self._context
        session, window, scene, cameras = context.session, context.guarded.editing(), context.scene_file(), None
        if scene is not None and scene.is_file():
            cameras = context.cameras()
        if session is None or cameras is None:
            return None
        if self._camera_slider.max != max(1, len(cameras) - 1):
            self._camera_slider.max = max(1, len(cameras) - 1)
        is_on_canvas = self._follow.value and window is not None and context.phase != "Select"
        if window is not None and self._follow.value:
            size, aspect = (self._canvas_width(window), 0.0) if is_on_canvas else (_PANEL_WIDTH, _MIN_ASPECT)
            camera = camera_from_viser(window.camera, width=width or size, min_aspect=aspect)
        else:
            camera = cameras[int(self._camera_slider.value)]
            camera = camera.resized((width or _PANEL_WIDTH) / camera.width)
        left, right = SOURCE_KINDS if context.phase == "Select" else (self._left.value, self._right.value)
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
        known = self._canvas_size[1] if aspect == self._canvas_size[0] else 0
        self._canvas_size = (aspect, max(width, known))
        return min(_MAX_WIDTH, max(64, self._canvas_size[1]))

    def _show_cameras(self) -> None:
        cameras = self._context.cameras() if self._frusta.value else None
        self._context.view.show_cameras(cameras, size=0.08 * self._context.scene_scale())

    def _to_camera(self) -> None:
        cameras = self._context.cameras()
        if cameras is not None:
            self._follow.value = False
            camera = cameras[min(int(self._camera_slider.value), len(cameras) - 1)]
            self._context.look_through(self._context.guarded.editing(), camera)

    def _step(self, by: int) -> None:
        cameras = self._context.cameras()
        if cameras is not None:
            self._camera_slider.value = (int(self._camera_slider.value) + by) % len(cameras)
            self._to_camera()

    # drawing, in the worker threads

    def _work(self, request: PictureRequest) -> None:
        if request.is_moved and not self._worker.wait_idle(_REST_SECONDS):
            return
        relighting, state = request.session.relighting, request.state
        if not request.session.scenes.at_hand(request.scenes()):
            self.canvas.clear()
            self._say("the scene is being read")
            return  # drawn when the scenes are there
        if not {request.left, request.right} & set(NEEDS_LIGHT) or relighting.is_relit(state):
            self._draw(request, note=self._light_note)
            return
        if relighting.best(state) is None:
            if self._draft_seconds > _MAX_DRAFT_SECONDS:
                # first the pictures that need no light transfer
                left, right = ("Copy-paste" if kind in NEEDS_LIGHT else kind for kind in (request.left, request.right))
                self._draw(replace(request, left=left, right=right), note="light: computing ...", stage="copy-paste")
                if self._worker.superseded:
                    return
            start = time.monotonic()
            relighting.draft(state)
            self._draft_seconds = time.monotonic() - start
        self._draw(replace(request, draft=True), note=f"a draft of the light in {self._draft_seconds:.1f} s")
        if not request.is_dragging:
            self._light_worker.submit(request)

    def _compute_light(self, request: PictureRequest) -> None:
        """The light as the step computes it, when nothing has changed for a moment."""
        relighting, state, worker = request.session.relighting, request.state, self._light_worker
        if relighting.is_relit(state) or not worker.wait_idle(_SETTLE_SECONDS):
            return
        if relighting.refine(state):
            if not worker.closed:
                self.update()  # once drawn, asks for the light itself
            return
        start = time.monotonic()
        relighting.relit(state)
        if worker.closed:
            return
        self._light_note = f"light in {time.monotonic() - start:.1f} s"
        self.light_ready()
        self.update()
        if worker.wait_idle(_REST_SECONDS):
            relighting.prepare_drafts(state)

    def _draw(self, request: PictureRequest, *, note: str, stage: str = "") -> None:
        if request.window is not None and self._picture_seconds > _COARSE_ABOVE:
            coarse = replace(request, camera=request.camera.resized(_COARSE_SHARE), budget=_COARSE_BUDGET)
            self._draw_once(coarse, note=note, stage="coarse")
            if self._worker.superseded:
                return
        self._draw_once(request, note=note, stage=stage or ("draft" if request.draft else "full quality"))

    def _draw_once(self, request: PictureRequest, *, note: str, stage: str) -> None:
        start = time.monotonic()
        problems: list[str] = []
        left, right = self._both(request, problems)
        seconds = time.monotonic() - start
        pixels = wipe_comparison(left.pixels, right.pixels, request.split)
        # the page was closed, or the canvas given to splats, while this picture was drawn
        if self._worker.closed or (request.window is not None and not self._is_on_canvas):
            return
        if request.window is not None:
            depth = right.depth if request.split < 0.5 else left.depth
            self.canvas.show(request.window, with_badge(pixels, stage), depth)
            self._shown_pose = _pose(request.camera)
            self._picture_seconds = seconds if stage != "coarse" else self._picture_seconds
        else:
            self._image.image = pixels
        self._say(" &middot; ".join((*self._described(request, left), *filter(None, (note,)), *problems)))

    def _both(self, request: PictureRequest, problems: list[str]) -> tuple[Picture, Picture]:
        """The left and the right picture; one of them alone is drawn where the other one is not seen.

        What could not be drawn is appended to `problems`; that picture is grey.
        """

        def drawn(kind: PictureKind) -> Picture:
            try:
                return self._drawn.get(kind, request.key(), lambda: request.draw(kind))
            except ValueError as error:
                problems.append(str(error))
                return Picture(np.full((request.camera.height, request.camera.width, 3), 48, np.uint8))

        if request.split <= 0 or request.left == request.right:
            right = drawn(request.right)
            return right, right
        left = drawn(request.left)
        return (left, left) if request.split >= 1 else (left, drawn(request.right))

    def _described(self, request: PictureRequest, picture: Picture) -> list[str]:
        """What the caption says of a picture."""
        (height, width), session = picture.pixels.shape[:2], request.session
        shown, found = (request.left, request.right), [f"{request.left} | {request.right}", f"{width} x {height}"]
        if "Light transfer" in shown and not session.files.transfers_light:
            found.append(session.relighting.light_mode_note())
        if "Photograph" in shown and session.files.without_photos[1]:
            found.append("no photograph: an image rendered of the scene, which has no photographs")
        why = session.why_stale("consolidate") if "Result" in shown and session.files.result.is_file() else None
        if why is not None:
            found.append(f"<b>the result is out of date</b> ({html.escape(why)}): see Run")
        return found

    def _say_error(self, error: Exception) -> None:
        traceback.print_exception(error)
        self._say(" ".join(str(error).split()))

    def _say(self, text: str) -> None:
        self._caption.content = (
            f'<div class="sg-caption" style="font-size:.78em;opacity:.75;padding:0 12px">{text}</div>'
        )


def _pose(camera: Cameras) -> bytes:
    """Pose, intrinsics and size, which identify a view."""
    return b"".join(part.numpy().tobytes() for part in (camera.world_from_camera, camera.intrinsics, camera.sizes))
