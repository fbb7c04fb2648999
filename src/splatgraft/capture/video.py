"""Extracts frames of a video at equal steps of motion, each the sharpest of its stretch."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from splatgraft.capture.video_motion import MotionTracker, choose_frames
from splatgraft.runtime.progress import Progress, silent

_SHARPNESS_PX = 480
"""Longest side at which sharpness is measured, so that it does not depend on the resolution."""
_LEAST_FRAMES = 3
VIDEO_FRAMES = 120
"""Frames taken of a video, where it has as many and different views."""
_MISSING_SHARE = 0.02
"""Share of the announced frames that may be missing before the file counts as cut off; containers count roughly."""
_WIDE_STEP = 0.15
"""Motion between frames, over the longest side, above which they may overlap too little."""
_STANDING_S = 1.0
"""Shortest time of standing still that is mentioned, seconds."""
_NAMED_CUTS = 5


def extract_frames(
    video: Path,
    folder: Path,
    *,
    count: int = VIDEO_FRAMES,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda sentence: None,
) -> list[Path]:
    """Write the sharpest frame of each of at most `count` stretches of equal motion of `video`, as PNG.

    Motion is the median displacement of tracked corners, so that a camera that stands still gives one frame however
    long it does. Sharpness is the variance of the Laplacian of the frame, reduced to 480 px; motion blur lowers it.

    Args:
        video: Any file that OpenCV can read.
        folder: Made where it does not exist.
        count: Frames to write; fewer if the picture moves less than 2% of its longest side between them.
        progress: Called every 25 frames, in two passes.
        say: Takes sentences for the user: how the frames were chosen, cuts, a truncated file.

    Returns:
        The files, in order of time.

    Raises:
        ValueError: Where `video` cannot be read, or has fewer than three frames or different views.
    """
    if count < 1:
        raise ValueError(f"{video}: expected at least 1 frame to extract, found {count}")
    with _opened(video) as capture:
        announced, rate = _announced(capture), capture.get(cv2.CAP_PROP_FPS)
        rate = rate if math.isfinite(rate) and 1 <= rate <= 1000 else 30.0
        tracker = MotionTracker()
        seen = [
            (*tracker.add(frame), _sharpness(frame)) for frame in _frames(capture, progress, "looking for sharp frames")
        ]
    if len(seen) < _LEAST_FRAMES:
        raise ValueError(f"{video}: expected a video of at least {_LEAST_FRAMES} frames, found {len(seen)}")
    path, cuts, sharpness = (np.array(values) for values in zip(*seen, strict=True))
    if len(seen) < (1 - _MISSING_SHARE) * announced:
        say(f"the file announces {announced} frames and {len(seen)} can be read: it is truncated or damaged")
    chosen, step = choose_frames(path, sharpness, np.cumsum(cuts), count)
    if len(chosen) < _LEAST_FRAMES:
        raise ValueError(
            f"{video}: expected a camera that moves around, found {len(chosen)} different views in {len(seen)} frames"
        )
    for sentence in _report(path, np.flatnonzero(cuts), rate, len(chosen), step):
        say(sentence)
    return _write(video, folder, set(chosen), progress)


def _report(path: np.ndarray, cuts: np.ndarray, rate: float, chosen: int, step: float) -> list[str]:
    said = [
        f"{chosen} of {len(path)} frames, each the sharpest of a stretch in which the picture moves by {step:.1%} of "
        f"its longest side"
    ]
    if step > _WIDE_STEP:
        said[0] += ": they may overlap too little; film more slowly, or give a shorter video"
    # a stretch of one second in which the picture moves less than a tenth of a step
    window = max(1, round(_STANDING_S * rate))
    if len(path) > window:
        still = np.abs(path[window:] - path[:-window]) < 0.1 * step
        seconds = float(still.sum()) / rate
        if seconds > 0:
            said.append(f"the camera stands still for about {seconds + _STANDING_S:.0f} s, which give no more frames")
    if len(cuts):
        times = ", ".join(f"{cut / rate:.1f} s" for cut in cuts[:_NAMED_CUTS])
        more = ", ..." if len(cuts) > _NAMED_CUTS else ""
        said.append(
            f"the video is cut at {times}{more}: frames before and after belong together only if they show one place"
        )
    return said


def _write(video: Path, folder: Path, chosen: set[int], progress: Progress) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    with _opened(video) as capture:
        for index, frame in enumerate(_frames(capture, progress, "writing frames")):
            if index in chosen:
                paths.append(folder / f"frame_{index:06d}.png")
                if not cv2.imwrite(str(paths[-1]), frame):
                    raise ValueError(f"{paths[-1]}: expected to write a frame here, found no way to")
    return paths


@dataclass(frozen=True)
class VideoFacts:
    """What a video file says about itself."""

    frames: int
    """Number of frames as announced; 0 where it announces none."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    seconds: float
    """Duration; 0 where it announces no frames."""


def read_video_facts(video: Path) -> VideoFacts:
    """Read the header and the first frame of a video.

    Args:
        video: The file.

    Raises:
        ValueError: There is no such file, OpenCV cannot read it, or it announces fewer than three frames.
    """
    with _opened(video) as capture:
        is_read, frame = capture.read()
        frames = _announced(capture)
        if not is_read or 0 < frames < _LEAST_FRAMES:
            found = f"{frames}" if is_read else "none that can be read"
            raise ValueError(f"{video}: expected a video of at least {_LEAST_FRAMES} frames, found {found}")
        rate = capture.get(cv2.CAP_PROP_FPS)
        seconds = frames / rate if math.isfinite(rate) and rate > 0 else 0.0
        return VideoFacts(frames, frame.shape[1], frame.shape[0], seconds)


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    if not video.is_file():
        raise ValueError(f"{video}: expected a video file, found none")
    if video.stat().st_size == 0:
        raise ValueError(f"{video}: expected a video file, found an empty one")
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            raise ValueError(
                f"{video}: expected a video that OpenCV can read (mp4, mov, avi, mkv), "
                f"found another file, a truncated one, or sound alone"
            )
        yield capture
    finally:
        capture.release()


def _announced(capture: cv2.VideoCapture) -> int:
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return int(announced) if math.isfinite(announced) and 0 < announced < 1e9 else 0


def _frames(capture: cv2.VideoCapture, progress: Progress, message: str) -> Iterator[np.ndarray]:
    total = _announced(capture)
    done = 0
    while True:
        readable, frame = capture.read()
        if not readable:
            return
        yield frame
        done += 1
        if done % 25 == 0:
            progress(done, max(done, total), message)


def _sharpness(frame: np.ndarray) -> float:
    scale = _SHARPNESS_PX / max(frame.shape[:2])
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else frame
    return float(cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), cv2.CV_64F).var())
