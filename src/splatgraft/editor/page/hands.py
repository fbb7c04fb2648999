"""Objects that the pointer drags over the canvas: the page's script asks, and gets a picture of each step."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.grab import Grab, GrabMode, Point2, outline
from splatgraft.editor.page.context import PageContext
from splatgraft.editor.page.scene_view import camera_from_viser
from splatgraft.editor.pictures import Picture, jpeg, with_object
from splatgraft.editor.state import check_state

_WIDTH = 960
"""Largest width of the pictures of a drag, pixels; the browser enlarges them."""
_QUALITY = 80
_MIN_OPACITY = 0.3
"""Opacity from which a Gaussian counts for the outline of its object."""


@dataclass(frozen=True, eq=False)
class _Held:
    """The object that is being dragged."""

    index: int
    grab: Grab
    background: Picture
    """The view without it."""
    gaussians: Gaussians
    """It in the target's frame, where it was grabbed."""

    def picture(self, placed: Similarity) -> bytes:
        """The view with it at another placement, as JPEG."""
        moved = (placed @ self.grab.placed.inverse()).gaussians(self.gaussians)
        pixels = with_object(self.background, moved, self.grab.camera)
        return jpeg(pixels, _QUALITY)


class ObjectHands:
    """Answers the requests `grab`, `drag`, `drop` and `cancel`; places are over the canvas's width and height."""

    def __init__(
        self,
        context: PageContext,
        *,
        on_grabbed: Callable[[int], None],
        on_dropped: Callable[[int, Similarity, GrabMode], None],
    ) -> None:
        """Hold nothing yet; both get the number of the object, and `on_dropped` how it was dragged, and where to."""
        self._context, self._on_grabbed, self._on_dropped = context, on_grabbed, on_dropped
        self._held: _Held | None = None
        self._lock = threading.Lock()
        context.guarded.hands |= {"grab": self._grab, "drag": self._drag, "drop": self._drop, "cancel": self._cancel}

    def release(self) -> None:
        """Hold nothing any more."""
        self._held = None

    def outlines(self, camera: Cameras) -> list[list[Point2]]:
        """The outline of each placed object in a view."""
        session, found = self._context.require_session(), []
        for index, item in enumerate(session.objects()):
            gaussians = session.placeable_object(index).gaussians
            solid = gaussians.means[gaussians.opacities > _MIN_OPACITY]
            found.append(outline(item.target_from_object.points(solid), camera))
        return found

    def _grab(self, query: Mapping[str, str]) -> None:
        context, session = self._context, self._context.require_session()
        window, index, mode = context.guarded.editing(), int(query["object"]), query["mode"]
        if window is None or context.phase != "Place" or not 0 <= index < len(session.objects()):
            raise ValueError("grab: expected a placed object in the phase Place, found none")
        modes: tuple[GrabMode, ...] = get_args(GrabMode)
        state, item = session.placed_state(), session.objects()[index]
        object_ = session.placeable_object(index)
        camera = camera_from_viser(window.camera, width=min(_WIDTH, max(64, window.camera.image_width)))
        with self._lock:
            background = session.pictures.without_object(state, index, camera)
            depth = np.full((camera.height, camera.width), np.inf) if background.depth is None else background.depth
            grab = Grab(
                item=object_,
                placed=item.target_from_object,
                camera=camera,
                depth=depth,
                up=session.up(),
                mode=modes[modes.index(mode)],  # pyright: ignore[reportArgumentType]
                start=_point(query),
            )
            moved = item.target_from_object.gaussians(object_.gaussians)
            self._held = _Held(index, grab, background, moved.with_sh_degree(min(1, moved.sh_degree)))
        self._on_grabbed(index)

    def _drag(self, query: Mapping[str, str]) -> bytes:
        with self._lock:
            held = self._required()
            return held.picture(self._placed(held, query))

    def _drop(self, query: Mapping[str, str]) -> None:
        with self._lock:
            held = self._required()
            placed, self._held = self._placed(held, query), None
        self._context.callback(lambda _: self._on_dropped(held.index, placed, held.grab.mode))(None)

    def _cancel(self, query: Mapping[str, str]) -> None:
        self.release()

    def _required(self) -> _Held:
        if self._held is None:
            raise ValueError("drag: expected an object that was grabbed, found none")
        return self._held

    def _placed(self, held: _Held, query: Mapping[str, str]) -> Similarity:
        placed = held.grab.at(_point(query))
        session = self._context.require_session()
        item = replace(session.objects()[held.index], target_from_object=placed)
        check_state(session.placed_state().with_object(held.index, item))
        return placed


def _point(query: Mapping[str, str]) -> Point2:
    x, y = float(query["x"]), float(query["y"])
    # a pointer may leave the canvas, and no number is too large for a request
    if not (-10 < x < 10 and -10 < y < 10):
        raise ValueError(f"pointer: expected a place near the canvas, found {x:g}, {y:g}")
    return x, y
