"""The renderer's pictures on the canvas, what the page's script is told of them, and steps through the cameras."""

import base64
import html
import json
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import viser
from jaxtyping import UInt8

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import write_image
from splatgraft.core.prompts import ViewPrompt
from splatgraft.editor.grab import Point2
from splatgraft.editor.memo import Memo
from splatgraft.editor.page.context import VIEW_ORDER, PageContext
from splatgraft.editor.page.scene_view import Canvas, camera_from_viser
from splatgraft.editor.photo_view import PhotoView, standing_at
from splatgraft.editor.pictures import (
    NEEDS_LIGHT,
    PICTURE_KINDS,
    SOURCE_KINDS,
    Picture,
    PictureKind,
    jpeg,
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
_NO_WINDOW_WIDTH, _MAX_WIDTH, _SAVED_WIDTH = 480, 1920, 1280
"""Pixels of a picture that no window shows, of the largest one on the canvas, which the browser enlarges, of a file."""
_BEFORE_QUALITY = 85
"""JPEG quality of the picture under the divider."""
_NAMES: dict[PictureKind, str] = {
    "Copy-paste": "pasted",
    "Light transfer": "with its new light",
    "Source": "photo",
    "Selection": "selected",
}
"""What the divider calls its two pictures, where that is not the name of their kind."""


@dataclass(frozen=True)
class PictureRequest:
    """What the worker is to draw."""

    session: Session
    state: EditState
    camera: Cameras
    left: PictureKind
    right: PictureKind
    window: viser.ClientHandle | None
    """The window whose canvas shows the picture; None: none is open."""
    photo: int | None = None
    """The number of the photo from whose place the scene is seen; None where it is seen from elsewhere."""
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
        prompts = state.prompts if self.is_of_source else None
        drawn = (_pose(self.camera), self.photo, self.draft, best_draft, self.budget, stamp)
        return (*drawn, state.objects, state.erased, state.light, state.weights, selection, prompts)

    def draw(self, kind: PictureKind) -> Picture:
        """Draw one of the pictures; ValueError where a file that it needs does not exist yet."""
        session, pictures = self.session, self.session.pictures
        if self.is_of_source:
            return pictures.of_source(kind, self.state, session.selection(), self.camera, self.photo)
        if kind == "Photograph" and self.photo is not None:
            camera = session.scenes.cameras(session.files.target_cameras)[self.photo]
            picture = pictures.view(kind, self.state, camera.resized(min(1.0, self.camera.width / camera.width)))
            view = PhotoView((camera.width, camera.height), (self.camera.width, self.camera.height))
            return Picture(view.drawn(picture.pixels, ViewPrompt()))
        return pictures.view(kind, self.state, self.camera, draft=self.draft, budget=self.budget)


class PreviewPanel:
    """Renders pictures in a worker thread for the canvas; only the newest request is rendered."""

    def __init__(self, context: PageContext) -> None:
        """Build the panel."""
        self._context, gui = context, context.gui
        self._drawn = Memo()
        self._dragged_state: EditState | None = None
        self._draft_seconds, self._picture_seconds = float("inf"), 0.0
        self.canvas = Canvas(context.server, context.view)
        self._shown_pose: bytes = b""
        self._canvas_size: tuple[float, int] = (0.0, 0)
        self._is_on_canvas = False
        """Whether the newest request is for the canvas."""
        self._told: dict[int, viser.GuiHtmlHandle] = {}
        """Where the script of a window is told of its picture: one place for each, however late a picture is drawn."""
        self._version = 0
        self._telling = threading.Lock()
        self.light_ready: Callable[[], None] = lambda: None
        """Called after the light has been estimated."""
        self.on_shown: Callable[[Cameras], None] = lambda camera: None
        """Called with the view of a picture that was put on the canvas."""
        self.outlines: Callable[[Cameras], list[list[Point2]]] = lambda camera: []
        """Gives the outlines of the objects that can be grabbed in a view."""
        self.is_object_alone = False
        """Whether the phase Select shows nothing but the object."""
        self._worker = LatestOnlyWorker(self._work, self._say_error)
        self._light_worker = LatestOnlyWorker(self._compute_light, self._say_error)
        context.on_close += [self._worker.close, self._light_worker.close]
        self._right = gui.add_dropdown("Picture", PICTURE_KINDS, initial_value="Light transfer", order=VIEW_ORDER)
        self._caption = gui.add_html("", order=VIEW_ORDER)
        with context.more_of("View"):
            self._left = gui.add_dropdown(
                "Before", PICTURE_KINDS, initial_value="Copy-paste", hint="Left of the divider, and while Tab is held"
            )
            self._camera_slider = gui.add_slider("Photo", 1, 2, 1, 1, hint="Look from the place of a photo")
            self._frusta = context.on(gui.add_checkbox("Show the cameras", False), self._show_cameras)
        for control in (self._left, self._right):
            control.on_update(lambda event: self.update() if event.client is not None else None)
        context.on(self._camera_slider, lambda: self.to_camera(int(self._camera_slider.value) - 1))

    def reset(self) -> None:
        """Discard pictures and timings for another project."""
        self.canvas.clear()
        self._drawn = Memo()
        self._draft_seconds = float("inf")

    def scene_changed(self) -> None:
        """Switch to the cameras of the other scene; the source has only one pair of pictures."""
        for control in (self._left, self._right, self._camera_slider):
            control.visible = self._context.phase != "Select"
        self._camera_slider.value = 1
        self._drawn = Memo()
        self._is_on_canvas = False
        self.canvas.clear()
        if (window := self._context.guarded.editing()) is not None:
            self._tell(window, [], None, ())
        self._show_cameras()

    def introduce(self, window: viser.ClientHandle) -> None:
        """Tell the script of the window that edits its number, before there is any picture."""
        with self._telling:
            clients = self._context.server.get_clients()
            self._told = {number: told for number, told in self._told.items() if number in clients}
            # a picture may have come first
            if window.client_id not in self._told:
                self._write(window, {"window": window.client_id, "hulls": []})

    def set_dragged_state(self, state: EditState | None) -> None:
        """Show `state` during a drag; None: show the saved state."""
        self._dragged_state = state
        self.update()

    def camera_moved(self) -> None:
        """Show splats while the editing window's view moves, and its picture when it rests."""
        self._submit(is_moved=True)

    def show(self, left: PictureKind, right: PictureKind) -> None:
        """Select the two kinds of pictures."""
        self._left.value, self._right.value = left, right
        self.update()

    def show_edits(self) -> None:
        """Select the pictures that follow the edits, where those of the result were selected, which do not."""
        if self._right.value == "Result":
            self.show("Copy-paste", "Light transfer")

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

    def photo(self) -> int | None:
        """The number of the photo from whose place the editing window sees the scene; None where from elsewhere."""
        window, cameras = self._context.guarded.editing(), self._context.cameras()
        if window is None or cameras is None:
            return None
        camera = camera_from_viser(window.camera, width=_NO_WINDOW_WIDTH)
        return standing_at(camera, cameras, scale=self._context.scene_scale())

    def to_camera(self, index: int) -> None:
        """Move the editing window's view to one of the scene's cameras."""
        cameras = self._context.cameras()
        if cameras is not None:
            self._context.look_through(self._context.guarded.editing(), cameras[index % len(cameras)])
            self._camera_slider.value = index % len(cameras) + 1

    def step_camera(self, by: int) -> None:
        """Move the view to the next camera, or the previous one."""
        photo = self.photo()
        self.to_camera(int(self._camera_slider.value) - 1 + by if photo is None else photo + by)

    # requests

    def _submit(self, *, is_moved: bool) -> None:
        request = self._request()
        self._right.visible = request is not None and self._context.phase != "Select"
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
        if self._camera_slider.max != max(2, len(cameras)):
            self._camera_slider.max = max(2, len(cameras))
        photo = None
        if window is not None:
            camera = camera_from_viser(window.camera, width=width or self._canvas_width(window))
            photo = standing_at(camera, cameras, scale=context.scene_scale())
        else:
            camera = cameras[min(int(self._camera_slider.value), len(cameras)) - 1]
            camera = camera.resized((width or _NO_WINDOW_WIDTH) / camera.width)
        left, right = self._left.value, self._right.value
        if context.phase == "Select":
            left, right = "Source", "Object alone" if self.is_object_alone else "Selection"
        return PictureRequest(
            session=session,
            state=self._dragged_state or session.placed_state(),
            camera=camera,
            left=left,
            right=right,
            window=window,
            photo=photo,
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

    # drawing, in the worker threads

    def _work(self, request: PictureRequest) -> None:
        if request.is_moved and not self._worker.wait_idle(_REST_SECONDS):
            return
        relighting, state = request.session.relighting, request.state
        if not request.session.scenes.at_hand(request.scenes()):
            self.canvas.clear()
            self._say("the scene is being read")
            return  # drawn when the scenes are there
        if request.right not in NEEDS_LIGHT or relighting.is_relit(state):
            self._draw(request, note="")
            return
        if relighting.best(state) is None:
            if self._draft_seconds > _MAX_DRAFT_SECONDS:
                # first the picture that needs no light transfer
                self._draw(replace(request, right="Copy-paste"), note="light: computing ...", stage="copy-paste")
                if self._worker.superseded:
                    return
            start = time.monotonic()
            relighting.draft(state)
            self._draft_seconds = time.monotonic() - start
        self._draw(replace(request, draft=True), note="a draft of the light")
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
        relighting.relit(state)
        if worker.closed:
            return
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
        right = self._picture(request, request.right, problems)
        seconds = time.monotonic() - start
        # the page was closed, or the canvas given to splats, while this picture was drawn
        if self._worker.closed or (request.window is not None and not self._is_on_canvas):
            return
        if request.window is not None:
            self.canvas.show(request.window, with_badge(right.pixels, stage), right.depth)
            self._shown_pose = _pose(request.camera)
            self._picture_seconds = seconds if stage != "coarse" else self._picture_seconds
        # what is chosen above need not be said again
        kind = f'<span style="display:none">{request.right}</span>'
        self._say(kind + " &middot; ".join((*self._described(request), *filter(None, (note,)), *problems)))
        if request.window is not None:
            hulls = self.outlines(request.camera)
            self._tell(request.window, hulls, None, ())
            self.on_shown(request.camera)
            if stage in ("draft", "full quality") and request.left != request.right and not self._worker.superseded:
                left = self._picture(
                    replace(request, draft=request.draft and request.left in NEEDS_LIGHT), request.left, []
                )
                if not self._worker.superseded:
                    self._tell(request.window, hulls, left.pixels, (request.left, request.right))

    def _picture(self, request: PictureRequest, kind: PictureKind, problems: list[str]) -> Picture:
        """One picture; a grey one where it could not be drawn, and the reason is appended to `problems`."""
        try:
            return self._drawn.get(kind, request.key(), lambda: request.draw(kind))
        except ValueError as error:
            problems.append(str(error))
            return Picture(np.full((request.camera.height, request.camera.width, 3), 48, np.uint8))

    def _tell(
        self,
        window: viser.ClientHandle,
        hulls: list[list[Point2]],
        before: UInt8[np.ndarray, "h w 3"] | None,
        kinds: tuple[PictureKind, ...],
    ) -> None:
        """Tell the page's script of a window what its canvas shows: what can be grabbed, and the picture before."""
        state: dict[str, object] = {"window": window.client_id, "hulls": hulls}
        if before is not None:
            encoded = base64.b64encode(jpeg(before, _BEFORE_QUALITY)).decode()
            names = [_NAMES.get(kind, kind.lower()) for kind in kinds]
            state |= {"before": f"data:image/jpeg;base64,{encoded}", "names": names}
        with self._telling:
            self._write(window, state)

    def _write(self, window: viser.ClientHandle, state: Mapping[str, object]) -> None:
        if window.client_id not in self._context.server.get_clients():
            return
        self._version += 1
        text = html.escape(json.dumps(state))
        content = f'<div class="sg-state" data-version="{self._version}" style="display:none">{text}</div>'
        if window.client_id in self._told:
            self._told[window.client_id].content = content
        else:
            self._told[window.client_id] = window.gui.add_html(content)

    def _described(self, request: PictureRequest) -> list[str]:
        """What the caption says of the picture."""
        session, shown = request.session, request.right
        found = []
        if shown == "Light transfer" and not session.files.transfers_light:
            found.append(session.relighting.light_mode_note())
        if shown == "Photograph" and session.files.without_photos[1]:
            found.append("no photograph: an image rendered of the scene, which has no photographs")
        is_shown = shown == "Result" and session.files.result.is_file() and self._context.phase != "Run"
        why = session.why_stale("consolidate") if is_shown else None
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
