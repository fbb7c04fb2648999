"""An animated picture as a film that players and phones know. Knows nothing about what it shows."""

import os
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageSequence

_CODECS = {"avc1": "H.264", "mp4v": "MPEG-4"}
"""By OpenCV's code, the best first; H.264 is what browsers play, and many builds of OpenCV cannot write it."""


def write_orbit_video(path: Path, animation: Path) -> str:
    """The frames of a .webp or .gif as .mp4, at their own speed; gives the name of the codec.

    Raises: ValueError where OpenCV can write no .mp4 here.
    """
    with Image.open(animation) as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        milliseconds = float(image.info.get("duration") or 50)
    # codecs take even sizes alone
    height, width = (side - side % 2 for side in frames[0].shape[:2])
    partial = path.with_name(f".{path.name}.partial.mp4")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        for code, name in _CODECS.items():
            film = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*code), 1000 / milliseconds, (width, height))
            if not film.isOpened():
                continue
            for frame in frames:
                film.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
            film.release()
            os.replace(partial, path)
            return name
    finally:
        cv2.utils.logging.setLogLevel(level)
        partial.unlink(missing_ok=True)
    raise ValueError(f"{path}: expected an OpenCV that can write .mp4, found none of {', '.join(_CODECS.values())}")
