"""Extracts evenly spaced frames of a video, each the sharpest of its interval."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from splatgraft.runtime.progress import Progress, silent

_SHARPNESS_PX = 480
"""Longest side at which sharpness is measured, so that it does not depend on the resolution."""


def extract_frames(video: Path, folder: Path, *, count: int = 120, progress: Progress = silent) -> list[Path]:
    """Write the sharpest frame of each of `count` equal intervals of `video` to `folder`, as PNG.

    Sharpness is the variance of the Laplacian of the frame, reduced to 480 px; motion blur lowers it.

    Args:
        video: Any file that OpenCV can read.
        folder: Made where it does not exist.
        count: Frames to write; fewer if the video has fewer.
        progress: Called every 25 frames, in two passes.

    Returns:
        The files, in order of time.

    Raises:
        ValueError: Where `video` cannot be read or has fewer than three frames.
    """
    if count < 1:
        raise ValueError(f"{video}: expected at least 1 frame to extract, found {count}")
    with _opened(video) as capture:
        sharpness = np.array([_sharpness(frame) for frame in _frames(capture, progress, "looking for sharp frames")])
    if len(sharpness) < 3:
        raise ValueError(f"{video}: expected a video of at least 3 frames, found {len(sharpness)}")
    chosen = _sharpest_per_interval(sharpness, count)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    with _opened(video) as capture:
        for index, frame in enumerate(_frames(capture, progress, "writing frames")):
            if index in chosen:
                paths.append(folder / f"frame_{index:06d}.png")
                if not cv2.imwrite(str(paths[-1]), frame):
                    raise ValueError(f"{paths[-1]}: expected to write a frame here, found no way to")
    return paths


def _sharpest_per_interval(sharpness: np.ndarray, count: int) -> set[int]:
    edges = np.linspace(0, len(sharpness), min(count, len(sharpness)) + 1).round().astype(int)
    return {int(start + np.argmax(sharpness[start:end])) for start, end in pairwise(edges)}


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    if not video.is_file():
        raise ValueError(f"{video}: expected a video file, found none")
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            raise ValueError(f"{video}: expected a video that OpenCV can read (mp4, mov, avi, mkv), found another file")
        yield capture
    finally:
        capture.release()


def _frames(capture: cv2.VideoCapture, progress: Progress, message: str) -> Iterator[np.ndarray]:
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    total = int(announced) if math.isfinite(announced) and announced > 0 else 0
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
