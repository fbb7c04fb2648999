"""Selection of video frames: the sharpest frame of each of many stretches of equal image motion.

1. Image motion and cuts are found by tracking corners (Lucas-Kanade) from a reference frame. The reference changes only
   after a certain displacement, so the jitter and noise of a camera at rest do not accumulate.
2. Each shot is divided into stretches of equal motion.
3. The sharpest frame of each stretch is written.

Motion is measured over the longest side of the picture. Constants are set by hand.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from splatgraft.core.images import IMAGE_SUFFIXES
from splatgraft.runtime.note import Note
from splatgraft.runtime.progress import Progress, silent

VIDEO_FRAMES = 120
"""Default number of frames taken from a video; a video with less motion gives fewer."""
_MIN_FRAMES = 3
_SHARPNESS_PX = 480  # longest side at which sharpness is measured, independent of the video's resolution
_MISSING_SHARE = 0.02  # largest share of announced frames that may be missing; containers count roughly
_TRACKED_PX = 320  # longest side at which corners are tracked
_CORNERS = 200  # most corners that are tracked
_MIN_CORNERS = 8  # fewest corners for tracking; a black frame has fewer
_RETURNED_PX = 1.0  # largest error of a corner tracked forward and back, pixels
_RENEWED_AFTER = 0.05  # displacement after which the reference frame changes
_RENEWED_BELOW = 0.6  # share of corners still tracked, below which the reference frame changes
_CUT_BELOW = 0.3  # share of corners tracked from the frame before, below which a cut lies between; blur leaves 0.6
_MIN_STEP = 0.02  # smallest motion between chosen frames, 13 pixels of 640: enough for depth in structure from motion
_STRETCH_MARGIN = 0.2  # share avoided at either end of a stretch, so that chosen neighbours are not adjacent frames
_WIDE_STEP = 0.15  # motion between chosen frames above which they may overlap too little
_STANDING_S = 1.0  # shortest pause that is reported, seconds
_NAMED_CUTS = 5  # most cuts that a note lists


def describe_video(video: Path) -> str:
    """Describe duration and size of a video by its header and its first frame."""
    with _opened(video) as capture:
        is_read, frame = capture.read()
        frames, rate = _announced(capture), capture.get(cv2.CAP_PROP_FPS)
        if not is_read or 0 < frames < _MIN_FRAMES:
            found = f"{frames}" if is_read else "none that can be read"
            raise ValueError(f"{video}: expected a video of at least {_MIN_FRAMES} frames, found {found}")
        seconds = frames / rate if math.isfinite(rate) and rate > 0 else 0.0
        return f"a video of {seconds:.0f} s, {frame.shape[1]} x {frame.shape[0]}"


def extract_frames(
    video: Path, folder: Path, *, count: int = VIDEO_FRAMES, progress: Progress = silent
) -> tuple[list[Path], tuple[Note, ...]]:
    """Divide a video into stretches of equal motion and write the sharpest frame of each as PNG.

    Motion is the median displacement of tracked corners, so a pause of any length gives one frame. Sharpness is the
    variance of the Laplacian of the frame, reduced to 480 px; motion blur lowers it.

    Args:
        video: Any file that OpenCV can read.
        folder: Folder of the frames, made if missing.
        count: Most frames to write; fewer if the picture would move less than 2% of its longest side between them.
        progress: Called every 25 frames, in two passes.

    Returns:
        The files in order of time, and notes on the choice: pauses, cuts, a truncated file.

    Raises:
        ValueError: The video cannot be read, or has fewer than 3 different views.
    """
    with _opened(video) as capture:
        announced, rate = _announced(capture), capture.get(cv2.CAP_PROP_FPS)
        rate = rate if math.isfinite(rate) and 1 <= rate <= 1000 else 30.0
        tracked, measured = itertools.tee(_frames(capture, progress, "looking for sharp frames"))
        seen = [(*m, s) for m, s in zip(motion(tracked), map(_sharpness, measured), strict=True)]
    if len(seen) < _MIN_FRAMES:
        raise ValueError(f"{video}: expected a video of at least {_MIN_FRAMES} frames, found {len(seen)}")
    path, cuts, sharpness = (np.array(values) for values in zip(*seen, strict=True))
    chosen, step = choose_frames(path, sharpness, np.cumsum(cuts), count)
    if len(chosen) < _MIN_FRAMES:
        raise ValueError(
            f"{video}: expected a camera that moves around, found {len(chosen)} different views in {len(seen)} frames"
        )
    notes = _notes(path, np.flatnonzero(cuts), rate, len(chosen), step)
    if len(seen) < (1 - _MISSING_SHARE) * announced:
        text = f"the file announces {announced} frames and {len(seen)} can be read: it is truncated or damaged"
        notes.insert(0, Note(text))
    folder.mkdir(parents=True, exist_ok=True)
    paths, wanted = [], set(chosen)
    with _opened(video) as capture:
        for index, frame in enumerate(_frames(capture, progress, "writing frames")):
            if index in wanted:
                paths.append(folder / f"frame_{index:06d}.png")
                # on Windows cv2.imwrite knows no path with letters of other countries
                paths[-1].write_bytes(cv2.imencode(".png", frame)[1].tobytes())
    return paths, tuple(notes)


def grey_frames(video: Path, count: int, longest_px: int) -> list[UInt8[np.ndarray, "_ _"]]:
    """Read the luma of at most `count` frames, evenly spaced in a video, reduced to `longest_px`."""
    found: list[np.ndarray] = []
    with _opened(video) as capture:
        total = _announced(capture)
        for k in range(min(count, total)):
            capture.set(cv2.CAP_PROP_POS_FRAMES, k * total // min(count, total))
            is_read, frame = capture.read()
            if is_read:
                # grey before reduction: the other order rounds differently
                found.append(_reduced(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), longest_px))
    if len(found) < _MIN_FRAMES:
        raise ValueError(f"{video}: expected a video of at least {_MIN_FRAMES} frames, found {len(found)}")
    return found


def motion(frames: Iterable[np.ndarray]) -> Iterator[tuple[float, bool]]:
    """Yield, for each frame, the motion so far over the longest side, and whether a cut precedes the frame."""
    # motion up to the reference frame, and up to this frame
    travelled = here = 0.0
    reference = before = corners = None
    for frame in frames:
        small = cv2.cvtColor(_reduced(frame, _TRACKED_PX), cv2.COLOR_BGR2GRAY)
        if reference is None or before is None or corners is None or before.shape != small.shape:
            travelled, reference, before, corners = here, small, small, _corners(small)
            yield here, False
            continue
        moved, share = _moved(reference, corners, small)
        if share < _RENEWED_BELOW:
            # too many corners have left the picture: track from the frame before
            travelled, reference, corners = here, before, _corners(before)
            moved, share = _moved(before, corners, small)
        tracked = len(corners) >= _MIN_CORNERS
        is_cut = tracked and share < _CUT_BELOW
        if tracked and not is_cut:
            here = travelled + moved
        if is_cut or not tracked or moved > _RENEWED_AFTER:
            travelled, reference, corners = here, small, _corners(small)
        before = small
        yield here, is_cut


def _corners(small: np.ndarray) -> Float[np.ndarray, "n 1 2"]:
    found = cv2.goodFeaturesToTrack(small, _CORNERS, 0.01, 5)
    return np.empty((0, 1, 2), np.float32) if found is None else found


def _moved(old: np.ndarray, corners: Float[np.ndarray, "n 1 2"], new: np.ndarray) -> tuple[float, float]:
    """Return the median displacement of the corners that are found again, and their share."""
    if len(corners) < _MIN_CORNERS:
        return 0.0, 0.0
    there, seen, _ = cv2.calcOpticalFlowPyrLK(old, new, corners, np.empty_like(corners))
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(new, old, there, np.empty_like(corners))
    error = np.linalg.norm(back - corners, axis=-1)[:, 0]
    good = (seen[:, 0] == 1) & (seen_back[:, 0] == 1) & (error < _RETURNED_PX)
    if not good.any():
        return 0.0, 0.0
    lengths = np.linalg.norm(there - corners, axis=-1)[:, 0][good]
    return float(np.median(lengths)) / max(new.shape), float(good.mean())


def choose_frames(
    path: Float[np.ndarray, "n"], sharpness: Float[np.ndarray, "n"], shots: np.ndarray, count: int
) -> tuple[list[int], float]:
    """Choose the sharpest frame of each stretch of equal motion.

    Args:
        path: Motion up to each frame, over the picture's longest side.
        sharpness: Sharpness of each frame, any unit.
        shots: Index of the shot of each frame, from 0; a stretch lies in one shot.
        count: Largest number of frames; each shot may add one.

    Returns:
        Indices of the chosen frames, and the motion in a stretch.
    """
    total = sum(float(np.ptp(path[shots == shot])) for shot in np.unique(shots))
    step = max(total / count, _MIN_STEP)
    chosen = []
    for shot in np.unique(shots):
        frames = np.flatnonzero(shots == shot)
        along = (path[frames] - path[frames].min()) / step
        # the last frame belongs to the last stretch
        last = max(0, int(np.ceil(along.max() - 1e-6)) - 1)
        stretches = np.minimum(np.floor(along), last)
        for stretch in np.unique(stretches):
            inside = stretches == stretch
            middle = inside & (np.abs(along - stretch - 0.5) <= 0.5 - _STRETCH_MARGIN)
            among = frames[middle if middle.any() else inside]
            chosen.append(int(among[np.argmax(sharpness[among])]))
    return sorted(chosen), step


def _notes(path: np.ndarray, cuts: np.ndarray, rate: float, chosen: int, step: float) -> list[Note]:
    said = [
        f"{chosen} of {len(path)} frames were taken, each the sharpest while the picture moves by {step:.1%} of "
        f"its longest side"
    ]
    if step > _WIDE_STEP:
        said[0] += ": they may overlap too little; film more slowly, or give a shorter video"
    # still: in one second the picture moves less than a tenth of a step
    window = max(1, round(_STANDING_S * rate))
    if len(path) > window:
        still = np.abs(path[window:] - path[:-window]) < 0.1 * step
        seconds = float(still.sum()) / rate
        if seconds > 0:
            said.append(f"the camera stands still for about {seconds + _STANDING_S:.0f} s, which adds no frames")
    if len(cuts):
        times = ", ".join(f"{cut / rate:.1f} s" for cut in cuts[:_NAMED_CUTS])
        more = ", ..." if len(cuts) > _NAMED_CUTS else ""
        said.append(
            f"the video is cut at {times}{more}: frames before and after fit together only if they show one place"
        )
    return [Note(text) for text in said]


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    if not video.is_file() or video.stat().st_size == 0:
        raise ValueError(f"{video}: expected a video file, found {'an empty one' if video.is_file() else 'none'}")
    if video.suffix.lower() in IMAGE_SUFFIXES:
        raise ValueError(f"{video}: expected a folder of photos from all sides, or a video, found a single photo")
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            found = "another file, a truncated one, or sound alone"
            raise ValueError(f"{video}: expected a video that OpenCV can read (mp4, mov, avi, mkv), found {found}")
        yield capture
    finally:
        capture.release()


def _announced(capture: cv2.VideoCapture) -> int:
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return int(announced) if math.isfinite(announced) and 0 < announced < 1e9 else 0


def _frames(capture: cv2.VideoCapture, progress: Progress, message: str) -> Iterator[np.ndarray]:
    total = _announced(capture)
    for done in itertools.count(1):
        is_read, frame = capture.read()
        if not is_read:
            return
        yield frame
        if done % 25 == 0:
            progress(done, max(done, total), message)


def _reduced(frame: np.ndarray, longest_px: int) -> np.ndarray:
    scale = longest_px / max(frame.shape[:2])
    return cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else frame


def _sharpness(frame: np.ndarray) -> float:
    grey = cv2.cvtColor(_reduced(frame, _SHARPNESS_PX), cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())
