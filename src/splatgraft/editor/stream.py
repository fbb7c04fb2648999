"""A stream of pictures for each window, drawn from its camera, its canvas and the state.

The resolution of moving pictures follows a time budget. When nothing has moved for a moment, a picture of full size
and quality is drawn.
"""

import io
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from splatgraft.editor.orbit import Orbit
from splatgraft.editor.server import Window

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

_BUDGET_SECONDS = 1 / 20  # to draw a moving picture; sending and showing it takes the rest of 1/15 s
_SMALLEST = 0.3  # share of the canvas's sides; smaller pictures take hardly less time, because all Gaussians are sorted
_REST_SECONDS = 0.25  # time without a move before the picture of full size is drawn
_MOVING_QUALITY, _FULL_QUALITY = 80, 92  # JPEG, 0 to 100
_LARGEST, _LEAST = 1920, 16  # pixels; largest longer side, which the browser enlarges, and smallest side
_IN_FLIGHT = 2  # unacknowledged pictures: one is shown while the next one is drawn
_LOST_SECONDS = 2.0  # time after which an unacknowledged picture counts as shown


@dataclass(eq=False)
class View:
    """The view of one window."""

    window: Window
    size: tuple[int, int] = (0, 0)
    """Width and height of the canvas, pixels; zeros until they are known."""
    orbits: dict[str, Orbit] = field(default_factory=dict)
    """Camera in each scene, by side."""
    split: float = 0.0
    """Position of the divider over the width; the comparison picture is left of it."""
    version: int = 0
    """Number of changes of the picture's content."""
    drawn: tuple[int, float] = (-1, 0.0)
    """Version of the last picture, and its size over the canvas's."""
    photo: int | None = None
    """Index of the photo whose camera is shown; None for other cameras."""
    moved_at: float = 0.0
    """Time of the last move, seconds of `time.monotonic`."""
    sent: int = 0
    """Number of pictures sent."""
    shown: int = 0
    """Number of the newest picture that the window has shown."""
    sent_at: float = 0.0
    scale: float = 0.5
    """Size of moving pictures over the canvas's."""

    @property
    def canvas(self) -> tuple[int, int]:
        """Width and height of the full picture, pixels."""
        most = min(1.0, _LARGEST / max(self.size))
        width, height = (max(_LEAST, round(most * side)) for side in self.size)
        return width, height


class Stream:
    """The thread that draws for all windows, in turn."""

    def __init__(self, artist: "Editor", on_error: Callable[[Exception], None]) -> None:
        """Start the thread without windows; `artist` gives cameras and pictures."""
        self._artist, self._on_error = artist, on_error
        self.views: list[View] = []
        """Views in the order in which their windows opened."""
        self._wake = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name="splatgraft stream", daemon=True)
        self._thread.start()

    def add(self, view: View) -> None:
        """Start to draw for a window."""
        with self._wake:
            self.views.append(view)
            self._wake.notify_all()

    def remove(self, window: Window) -> None:
        """Stop drawing for a window."""
        with self._wake:
            self.views = [view for view in self.views if view.window is not window]

    def of(self, window: Window) -> View | None:
        """Return the view of a window; None if it has closed."""
        return next((view for view in self.views if view.window is window), None)

    def touch(self, view: View | None = None, *, moving: bool = False) -> None:
        """Redraw one window, or all."""
        with self._wake:
            for one in self.views if view is None else [view]:
                one.version += 1
                one.moved_at = time.monotonic() if moving else one.moved_at
            self._wake.notify_all()

    def is_at_rest(self, seconds: float) -> bool:
        """Return whether all windows have got their full pictures, and nothing has moved for some time."""
        with self._wake:
            now = time.monotonic()
            return all(
                view.sent and self._wait(view, now) == np.inf and now - view.moved_at > seconds for view in self.views
            )

    def wait_drawn(self, view: View, seconds: float) -> None:
        """Wait until a window's current content is drawn, at most `seconds`."""
        with self._wake:
            version = view.version
            self._wake.wait_for(lambda: view.drawn[0] >= version or not self._open, timeout=seconds)

    def acknowledge(self, view: View, number: int) -> None:
        """Record that a window has shown a picture."""
        with self._wake:
            view.shown = max(view.shown, min(number, view.sent))
            self._wake.notify_all()

    def close(self) -> None:
        """End the thread after the current picture."""
        with self._wake:
            self._open = False
            self._wake.notify_all()
        self._thread.join(timeout=1.0)

    def _run(self) -> None:
        while True:
            with self._wake:
                if not self._open:
                    return
                now = time.monotonic()
                waits = [(self._wait(view, now), view) for view in self.views]
                soon = min((wait for wait, _ in waits), default=np.inf)
                if soon > 0:
                    self._wake.wait(timeout=None if soon == np.inf else soon)
                    continue
                # windows take turns
                view = min((view for wait, view in waits if wait <= 0), key=lambda view: view.sent_at)
                version, is_moving = view.version, now - view.moved_at < _REST_SECONDS
            try:
                self._draw(view, version, view.scale if is_moving else 1.0)
            except Exception as error:  # one failed picture must not end the thread
                view.drawn = (version, 1.0)
                if self._open:
                    self._on_error(error)

    @staticmethod
    def _wait(view: View, now: float) -> float:
        """Return the seconds until a window must be drawn; infinite if it is up to date."""
        version, size = view.drawn
        if not all(view.size) or (version == view.version and size == 1.0):
            return np.inf
        if view.sent - view.shown >= _IN_FLIGHT:
            return max(0.0, view.sent_at + _LOST_SECONDS - now)
        return 0.0 if version != view.version else max(0.0, view.moved_at + _REST_SECONDS - now)

    def _draw(self, view: View, version: int, scale: float) -> None:
        # the size first: a picture of a new size then shows all moves before it
        (width, height), orbit = view.canvas, self._artist.orbit(view)
        if orbit is None:
            view.drawn = (version, 1.0)
            return
        start = time.monotonic()
        small = max(_LEAST, round(scale * width)), max(_LEAST, round(scale * height))
        pixels, over = self._artist.draw(view, orbit.camera(*small))
        content = io.BytesIO()
        Image.fromarray(pixels).save(content, "JPEG", quality=_FULL_QUALITY if scale == 1.0 else _MOVING_QUALITY)
        seconds = time.monotonic() - start
        if scale < 1.0 or seconds < _BUDGET_SECONDS:
            # half of the time does not depend on the size
            factor = np.clip((_BUDGET_SECONDS / seconds) ** 0.5, 0.7, 1.2)
            view.scale = float(np.clip(view.scale * factor, _SMALLEST, 1.0))
        with self._wake:
            view.sent += 1
            view.sent_at = time.monotonic()
            view.drawn = (version, scale)
            self._wake.notify_all()
        head = {"n": view.sent, "full": scale == 1.0, "split": view.split, **over}
        packed = json.dumps(head).encode()
        view.window.send("picture", len(packed).to_bytes(4, "little") + packed + content.getvalue())
