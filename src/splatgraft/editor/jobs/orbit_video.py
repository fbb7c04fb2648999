"""Conversion of an animated image (the report's orbit around the object) to an .mp4 video."""

import os
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageSequence

_CODECS = {"avc1": "H.264", "mp4v": "MPEG-4"}
"""By OpenCV code, in order of preference: browsers play H.264, but many builds of OpenCV cannot write it."""


def write_orbit_video(path: Path, animation: Path) -> str:
    """Write the frames of a .webp or .gif as .mp4 at the same frame rate; returns the name of the codec.

    Raises:
        ValueError: If this build of OpenCV cannot write .mp4.
    """
    with Image.open(animation) as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        milliseconds = float(image.info.get("duration") or 50)
    # the codecs require even sizes
    height, width = (side - side % 2 for side in frames[0].shape[:2])
    partial = path.with_name(f".{path.name}.partial.mp4")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        for code, name in _CODECS.items():
            video = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*code), 1000 / milliseconds, (width, height))
            if not video.isOpened():
                continue
            for frame in frames:
                video.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
            video.release()
            os.replace(partial, path)
            return name
    finally:
        cv2.utils.logging.setLogLevel(level)
        partial.unlink(missing_ok=True)
    raise ValueError(f"{path}: expected an OpenCV that can write .mp4, found none of {', '.join(_CODECS.values())}")
