"""How far the picture of a video has moved at each frame, and where it is cut, by tracking corners (Lucas-Kanade).

Corners are tracked from a reference frame, which is renewed after a known displacement: jitter and noise of a camera
that stands still do not add up.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class MotionOptions:
    """How motion between frames is measured; lengths over the picture's longest side, values set by hand."""

    side_px: int = 320
    """Longest side at which corners are tracked."""
    corners: int = 200
    """Corners that are tracked."""
    renewed_after: float = 0.05
    """Displacement after which another reference frame is taken."""
    renewed_below: float = 0.6
    """Share of corners still tracked below which another is taken."""
    cut_below: float = 0.3
    """Share of corners tracked from the frame before below which it is another shot; blurred motion has 0.6."""
    least_corners: int = 8
    """Corners below which a frame has nothing to track, such as a black one."""
    returned_px: float = 1.0
    """Largest error of a corner tracked forth and back."""


class MotionTracker:
    """Takes frames in order and says how far the picture has moved in all."""

    def __init__(self, options: MotionOptions = MotionOptions()) -> None:
        """Before the first frame."""
        self._options = options
        self._reference: np.ndarray | None = None
        self._corners = np.empty((0, 1, 2), np.float32)
        self._before: np.ndarray | None = None
        self._travelled = 0.0
        self._here = 0.0

    def add(self, frame: np.ndarray) -> tuple[float, bool]:
        """The path of the picture up to `frame`, over its longest side, and whether a cut comes before it."""
        small = _gray(frame, self._options.side_px)
        if self._reference is None or self._before is None or self._before.shape != small.shape:
            self._renew(small)
            return self._here, False
        moved, share = self._moved(self._reference, self._corners, small)
        if share < self._options.renewed_below:
            # too much has left the picture: go on from the frame before
            self._renew(self._before)
            moved, share = self._moved(self._before, self._corners, small)
        tracked = len(self._corners) >= self._options.least_corners
        is_cut = tracked and share < self._options.cut_below
        if is_cut or not tracked:
            self._renew(small)
            return self._here, is_cut
        self._here = self._travelled + moved
        if moved > self._options.renewed_after:
            self._renew(small)
        self._before = small
        return self._here, False

    def _renew(self, small: np.ndarray) -> None:
        self._travelled = self._here
        self._reference = self._before = small
        found = cv2.goodFeaturesToTrack(small, self._options.corners, 0.01, 5)
        self._corners = np.empty((0, 1, 2), np.float32) if found is None else found

    def _moved(self, old: np.ndarray, corners: np.ndarray, new: np.ndarray) -> tuple[float, float]:
        """Median displacement of the corners that are found again, and their share."""
        if len(corners) < self._options.least_corners:
            return 0.0, 0.0
        there, seen, _ = cv2.calcOpticalFlowPyrLK(old, new, corners, np.empty_like(corners))
        back, seen_back, _ = cv2.calcOpticalFlowPyrLK(new, old, there, np.empty_like(corners))
        error = np.linalg.norm(back - corners, axis=-1)[:, 0]
        good = (seen[:, 0] == 1) & (seen_back[:, 0] == 1) & (error < self._options.returned_px)
        if not good.any():
            return 0.0, 0.0
        lengths = np.linalg.norm(there - corners, axis=-1)[:, 0][good]
        return float(np.median(lengths)) / max(new.shape), float(good.mean())


@dataclass(frozen=True)
class FrameChoice:
    """Which frames are taken; lengths over the picture's longest side, values set by hand."""

    least_step: float = 0.02
    """Motion between two frames, at least: 13 pixels of 640, from which structure from motion gains depth."""
    margin: float = 0.2
    """Share of a stretch at either end that is avoided, so that neighbours do not meet there."""


def choose_frames(
    path: Float[np.ndarray, "n"],
    sharpness: Float[np.ndarray, "n"],
    shots: np.ndarray,
    count: int,
    *,
    options: FrameChoice = FrameChoice(),
) -> tuple[list[int], float]:
    """The sharpest frame of each of at most `count` stretches of equal motion; shots are not mixed.

    Args:
        path: Motion up to each frame, over the picture's longest side.
        sharpness: Of each frame, any unit.
        shots: Number of the shot of each frame, from 0 up.
        count: Largest number of frames; one more per shot may come.
        options: Shortest stretch and its margins.

    Returns:
        Positions in order, and the length of a stretch.
    """
    total = sum(float(np.ptp(path[shots == shot])) for shot in np.unique(shots))
    step = max(total / count, options.least_step)
    chosen = []
    for shot in np.unique(shots):
        frames = np.flatnonzero(shots == shot)
        along = (path[frames] - path[frames].min()) / step
        # the last frame ends the last stretch, and is none of its own
        last = max(0, int(np.ceil(along.max() - 1e-6)) - 1)
        stretches = np.minimum(np.floor(along), last)
        for stretch in np.unique(stretches):
            inside = stretches == stretch
            middle = inside & (np.abs(along - stretch - 0.5) <= 0.5 - options.margin)
            among = frames[middle if middle.any() else inside]
            chosen.append(int(among[np.argmax(sharpness[among])]))
    return sorted(chosen), step


def _gray(frame: np.ndarray, side_px: int) -> np.ndarray:
    scale = side_px / max(frame.shape[:2])
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else frame
    return cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
