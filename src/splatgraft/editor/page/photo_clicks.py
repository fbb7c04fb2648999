"""A photo of the source on the canvas, in which clicks say what is the object and what is not."""

import html
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath

import cv2
import numpy as np
import torch
import viser
from jaxtyping import UInt8

from splatgraft.core.images import read_upright
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.prompts import ViewPrompt
from splatgraft.editor.page.context import PageContext, note
from splatgraft.editor.page.scene_view import Canvas

_KINDS = ("on the object", "beside it")
_LONGEST_PX = 1920
"""Longest side of a photo on the canvas, pixels; on a larger canvas the browser enlarges it."""
_TAKES_POINTS = (None, "auto", "grabcut", "sam2")
"""Values of `mask_source` of which the points count."""
_OTHER_SHAPE = 0.01
"""Relative change of the canvas's shape after which the photo is drawn again."""
_NEAR = 0.012
"""A click this near to a point removes it; distance over the photo's longer side."""
_RADIUS = 0.007
"""Radius of a drawn point over the canvas's longer side."""
_INSIDE, _OUTSIDE, _EDGE = (60, 220, 90), (235, 40, 60), (255, 255, 255)
_BACKGROUND = 24
"""Grey beside the photo, 0 to 255."""


@dataclass(frozen=True)
class PhotoView:
    """A photo in the middle of a canvas, as large as it fits."""

    photo: tuple[int, int]
    """Width and height of the photo as a viewer shows it, pixels."""
    canvas: tuple[int, int]
    """Width and height of the canvas, pixels."""

    @property
    def scale(self) -> float:
        """Pixels of the canvas over those of the photo."""
        return min(self.canvas[0] / self.photo[0], self.canvas[1] / self.photo[1])

    @property
    def corner(self) -> tuple[float, float]:
        """The photo's upper left corner on the canvas, pixels."""
        x, y = (0.5 * (side - self.scale * of) for side, of in zip(self.canvas, self.photo, strict=True))
        return x, y

    def pixel_at(self, place: tuple[float, float]) -> tuple[float, float] | None:
        """The photo's pixel at a place, over the canvas's width and height; None beside the photo."""
        (left, top), (width, height) = self.corner, self.photo
        x, y = (place[0] * self.canvas[0] - left) / self.scale, (place[1] * self.canvas[1] - top) / self.scale
        return (x, y) if 0 <= x < width and 0 <= y < height else None

    def drawn(self, pixels: UInt8[np.ndarray, "h w 3"], prompt: ViewPrompt) -> UInt8[np.ndarray, "y x 3"]:
        """The canvas: the photo of any size, with the points and the rectangle of a prompt."""
        left, top = (round(x) for x in self.corner)
        width, height = (max(1, round(self.scale * side)) for side in self.photo)
        width, height = min(width, self.canvas[0] - left), min(height, self.canvas[1] - top)
        out = np.full((self.canvas[1], self.canvas[0], 3), _BACKGROUND, np.uint8)
        out[top : top + height, left : left + width] = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
        radius = max(3, round(_RADIUS * max(self.canvas)))

        def at(x: float, y: float) -> tuple[int, int]:
            return round(self.corner[0] + self.scale * x), round(self.corner[1] + self.scale * y)

        if prompt.box is not None:
            cv2.rectangle(out, at(*prompt.box[:2]), at(*prompt.box[2:]), _INSIDE, max(1, radius // 3))
        for points, color in ((prompt.inside, _INSIDE), (prompt.outside, _OUTSIDE)):
            for x, y in points.tolist():
                cv2.circle(out, at(x, y), radius + 2, _EDGE, -1, cv2.LINE_AA)
                cv2.circle(out, at(x, y), radius, color, -1, cv2.LINE_AA)
        return out


def prompt_of(prompts: Mapping[str, ViewPrompt] | None, name: str) -> ViewPrompt:
    """What is said in one photo; nothing where it is not named."""
    return (prompts or {}).get(_key(prompts or {}, name), ViewPrompt())


def with_click(
    prompts: Mapping[str, ViewPrompt] | None,
    name: str,
    pixel: tuple[float, float],
    *,
    on_object: bool,
    longer_side: int,
) -> dict[str, ViewPrompt] | None:
    """The prompts with one more point, or without the point that was clicked; None where none is left.

    `pixel` is x and y of the photo of that name as a viewer shows it, whose `longer_side` is in pixels.
    """
    found, key = dict(prompts or {}), _key(prompts or {}, name)
    prompt, point = found.get(key, ViewPrompt()), torch.tensor([pixel]).round(decimals=1)
    near = {kind: (getattr(prompt, kind) - point).norm(dim=1) < _NEAR * longer_side for kind in ("inside", "outside")}
    if any(bool(flags.any()) for flags in near.values()):
        prompt = replace(prompt, **{kind: getattr(prompt, kind)[~flags] for kind, flags in near.items()})
    else:
        kind = "inside" if on_object else "outside"
        prompt = replace(prompt, **{kind: torch.cat([getattr(prompt, kind), point])})
    found[key] = prompt
    if not len(prompt.inside) and not len(prompt.outside) and prompt.box is None:
        del found[key]
    return found or None


class PhotoClicks:
    """The controls, and the photo in the window that edits."""

    def __init__(self, context: PageContext) -> None:
        """Build the controls in the current folder of the panel."""
        self._context, gui = context, context.gui
        with gui.add_folder("Points in photos", expand_by_default=False):
            self._show = gui.add_checkbox("Show a photo", False, hint="Click into it; a click on a point removes it")
            self._kind = context.on(gui.add_dropdown("A click is", _KINDS), lambda: None)
            self._number = context.on(gui.add_slider("Photo", 1, 2, 1, 1), lambda: None)
            self._note = gui.add_html("")
            self._clear = gui.add_button("Clear all points", icon=viser.Icon.ERASER, color="gray")
        self._canvas = Canvas(context.server, context.view)
        self._view: PhotoView | None = None
        self._window: int | None = None
        context.on(self._show, self._say)
        context.on(self._clear, self._remove_all)
        context.on_moved.append(self._moved)

    @property
    def is_shown(self) -> bool:
        """Whether the canvas shows a photo."""
        return self._view is not None

    def leave(self) -> None:
        """Show the scene again."""
        if self._view is not None:
            self._context.server.scene.remove_click_callback(self._clicked)
            self._view = None
            self._canvas.clear()

    def refresh(self) -> None:
        """Update the controls, and show the photo where that is wanted."""
        session, window = self._context.require_session(), self._context.guarded.editing()
        self._clear.disabled = session.state.prompts is None
        if not self._show.value or window is None or not session.files.source_cameras.is_file():
            self.leave()
            self._note.content = note(self._count(), kind="photo")
            return
        capture = self._capture()
        if self._number.max != max(2, len(capture)):
            self._number.max = max(2, len(capture))
        index = self._index(capture)
        path, name = capture.image_paths[index], capture.cameras.names[index]
        stamp = path.stat().st_mtime_ns if path.is_file() else 0
        pixels, size = session.scenes.derive("photo", (str(path), stamp), lambda: read_upright(path, _LONGEST_PX))
        aspect = window.camera.aspect if window.camera.aspect > 0 else 1.5
        width = min(_LONGEST_PX, max(256, window.camera.image_width))
        view = PhotoView(size, (width, max(16, round(width / aspect))))
        if self._view is None:
            self._context.server.scene.on_click()(self._clicked)
        self._view, self._window = view, window.client_id
        self._canvas.show(window, view.drawn(pixels, prompt_of(session.state.prompts, name)), None)
        self._note.content = note(f"{html.escape(name)}<br>{self._count()}", kind="photo")

    def _capture(self) -> PosedImages:
        session = self._context.require_session()
        return session.scenes.capture(session.files.source_cameras)

    def _index(self, capture: PosedImages) -> int:
        return min(int(self._number.value), len(capture)) - 1

    def _count(self) -> str:
        prompts = self._context.require_session().state.prompts or {}
        inside, outside = (sum(len(getattr(p, kind)) for p in prompts.values()) for kind in ("inside", "outside"))
        if not prompts:
            return "No points yet; some in two or three photos are usually enough."
        where = "1 photo" if len(prompts) == 1 else f"{len(prompts)} photos"
        return f"<b>{inside}</b> on the object, <b>{outside}</b> beside it, in {where}"

    def _say(self) -> None:
        if self._show.value:
            self._context.say("click on the object and beside it in two or three photos, then cut it out")

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._context.callback(self._add)(event)

    def _add(self, event: viser.SceneClickEvent) -> None:
        session, view = self._context.require_session(), self._view
        if view is None or event.client_id != self._window:
            return
        pixel = view.pixel_at(event.screen_pos)
        if pixel is None:
            self._context.say("that was beside the photo")
            return
        capture = self._capture()
        name, on_object = capture.cameras.names[self._index(capture)], self._kind.value == _KINDS[0]
        prompts = with_click(session.state.prompts, name, pixel, on_object=on_object, longer_side=max(view.photo))
        state, takes = replace(session.state, prompts=prompts), session.state.mask_source in _TAKES_POINTS
        session.change(state if takes else replace(state, mask_source="auto"))
        prompt = prompt_of(prompts, name)
        counts = f"{len(prompt.inside)} on the object, {len(prompt.outside)} beside it"
        self._context.say(f"points in {name}: {counts}{'' if takes else '; masks are cut by the points now'}")

    def _remove_all(self) -> None:
        session = self._context.require_session()
        session.change(replace(session.state, prompts=None))

    def _moved(self) -> None:
        """Draw the photo again where the editing window's shape has changed."""
        view, editing = self._view, self._context.guarded.editing()
        if view is None or editing is None:
            return
        shape = view.canvas[0] / view.canvas[1]
        if editing.client_id != self._window or abs(editing.camera.aspect / shape - 1) > _OTHER_SHAPE:
            self._context.callback(lambda _: None)(None)


def _key(prompts: Mapping[str, ViewPrompt], name: str) -> str:
    """How the prompts call a photo: by its name, with or without folder and suffix."""
    path = PurePath(name)
    return next((key for key in (name, path.name, path.stem) if key in prompts), name)
