"""Turntables: cameras around a scene's middle, and their pictures as a video (.mp4) or an animation (.gif, .webp)."""

import math
import os
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import tangents
from splatgraft.evaluation import TurntableOptions, turntable_cameras
from splatgraft.exports.export_source import ExportSource
from splatgraft.exports.first_view import FirstView

FPS = 24
_QUALITY = "19"
"""Constant rate factor of x264: no loss is seen."""


def path_around(source: ExportSource, view: FirstView, *, frames: int, width: int) -> Cameras:
    """Cameras on a closed path around the view's centre.

    Between the captured viewpoints where there are cameras, else on a circle through the first view. Sides are even
    numbers of pixels, as video needs them.

    Raises:
        ValueError: Fewer than two frames.
    """
    if frames < 2:
        raise ValueError(f"--frames: expected 2 or more, found {frames}")
    if source.cameras is not None:
        center, up = torch.tensor(view.center), torch.tensor(view.up)
        options = TurntableOptions(frames=frames)
        cameras = turntable_cameras(source.cameras, center, up=up, options=options)
        cameras = cameras.resized(width / float(cameras.sizes[0, 0]))
        wide, high = cameras.sizes[0].tolist()
        return cameras.cropped([(0, 0, wide - wide % 2, high - high % 2)] * frames)
    up, center = torch.tensor(view.up), torch.tensor(view.center)
    across, along = tangents(up)
    offset = torch.tensor(view.eye) - center
    start, ring = torch.atan2(offset @ along, offset @ across), torch.hypot(offset @ across, offset @ along)
    angles = start + 2 * math.pi * torch.arange(frames) / frames
    eyes = center + ring * (angles.cos()[:, None] * across + angles.sin()[:, None] * along) + (offset @ up) * up
    first = view.camera(width - width % 2)
    height = first.height - first.height % 2
    return pinhole(look_at(eyes, center, up), float(first.intrinsics[0, 0, 0]), width=first.width, height=height)


def write_video(path: Path, frames: Iterable[Float[Tensor, "h w 3"]]) -> str:
    """Write sRGB pictures of one size as .mp4; gives the name of the codec.

    H.264 where PyAV is installed, which every player knows; else VP9 by OpenCV, which browsers know. The file appears
    whole or not at all.

    Raises:
        ValueError: The encoder does not start.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    partial = path.with_name(f".{path.stem}.partial.mp4")
    try:
        codec = _by_pyav(partial, frames) if find_spec("av") else _by_opencv(path, partial, frames)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return codec


def _by_pyav(path: Path, frames: Iterable[Float[Tensor, "h w 3"]]) -> str:
    import av

    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = None
        for frame in frames:
            pixels = _bytes(frame)
            if stream is None:
                stream = container.add_stream("libx264", rate=FPS, options={"crf": _QUALITY})
                stream.height, stream.width = pixels.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode())
    return "H.264"


def _by_opencv(path: Path, partial: Path, frames: Iterable[Float[Tensor, "h w 3"]]) -> str:
    import cv2

    writer = None
    for frame in frames:
        pixels = _bytes(frame)
        if writer is None:
            size = (pixels.shape[1], pixels.shape[0])
            writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*"vp09"), FPS, size)
            if not writer.isOpened():
                raise ValueError(f"{path}: expected OpenCV to encode VP9, found that it cannot; pip install av")
        writer.write(pixels[..., ::-1])
    if writer is not None:
        writer.release()
    return "VP9"


def _bytes(frame: Float[Tensor, "h w 3"]) -> np.ndarray:
    return np.ascontiguousarray((frame.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
