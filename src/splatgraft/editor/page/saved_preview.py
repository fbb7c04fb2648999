"""The picture that the canvas showed last, kept in the editor's folder: the start page shows it."""

import contextlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from splatgraft.project.layout import EDITOR_FOLDER, PREVIEW_FILE
from splatgraft.runtime.files import atomic_write

_WIDTH = 640
"""Pixels."""


def save_preview(root: Path, pixels: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture small; a full disk must not end the drawing, so that nothing is written then.

    Args:
        root: Folder of the project's results.
        pixels: The picture, sRGB.
    """
    height, width = pixels.shape[:2]
    scale = min(1.0, _WIDTH / width)
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    small = cv2.resize(np.ascontiguousarray(pixels[..., ::-1]), size, interpolation=cv2.INTER_AREA)
    with contextlib.suppress(OSError, ValueError), atomic_write(root / EDITOR_FOLDER / PREVIEW_FILE) as stream:
        stream.write(cv2.imencode(".jpg", small)[1].tobytes())
