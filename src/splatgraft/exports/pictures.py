"""Pictures of a scene: one from the first view, or a turntable as an animation or a video."""

import os
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_image
from splatgraft.evaluation import write_animation
from splatgraft.exports.export_source import FirstView
from splatgraft.rendering import render
from splatgraft.runtime.files import atomic_write, writable
from splatgraft.runtime.progress import Progress, silent

FPS = 24
_LEAST_BYTES = 1 << 12  # smaller than any video; a disk with less room is full
_QUALITY = "19"  # constant rate factor of x264, visually lossless


def write_picture(path: Path, gaussians: Gaussians, view: FirstView, *, width: int, with_alpha: bool) -> None:
    """Write the first view as .png or .jpg; `with_alpha` gives a .png with straight alpha, else black lies behind."""
    drawn = render(gaussians, view.camera(width))
    color = drawn.color[0].clamp(0, 1)
    if not with_alpha:
        write_image(path, color)
        return
    alpha = drawn.alpha[0].clamp(0, 1)[..., None]
    straight = torch.where(alpha > 0, color / alpha.clamp_min(1e-6), color).clamp(0, 1)
    pixels = (torch.cat([straight, alpha], -1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "PNG")


def write_turntable(path: Path, gaussians: Gaussians, cameras: Cameras, *, progress: Progress = silent) -> str:
    """Write the views of a path of cameras as .mp4, .gif or .webp; gives a sentence on the result."""
    frames = len(cameras)
    if path.suffix.lower() == ".mp4":
        codec = write_video(path, _drawn(gaussians, cameras, progress))
        return f"{frames / FPS:.1f} s of {cameras.width} x {cameras.height} in {codec}"
    write_animation(path, list(_drawn(gaussians, cameras, progress)), fps=float(FPS))
    return f"{frames / FPS:.1f} s, scaled down if it would be larger than 6 MB"


def _drawn(gaussians: Gaussians, cameras: Cameras, progress: Progress) -> Iterator[Float[Tensor, "h w 3"]]:
    for index, camera in enumerate(cameras):
        progress(index, len(cameras), "pictures")
        yield render(gaussians, camera).color[0].clamp(0, 1)
    progress(len(cameras), len(cameras), "pictures")


def write_video(path: Path, frames: Iterable[Float[Tensor, "h w 3"]]) -> str:
    """Write sRGB pictures of one size as .mp4; gives the name of the codec.

    With PyAV it is H.264, which every player reads; without, it is VP9 by OpenCV, which browsers read. The file is
    written atomically.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    partial = path.with_name(f".{path.stem}.partial.mp4")
    try:
        with writable(path):
            partial.write_bytes(bytes(_LEAST_BYTES))
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

    writer, written, count = None, None, 0
    # a frame is encoded while the next one is rendered
    with ThreadPoolExecutor(1) as pool:
        for frame in frames:
            pixels, count = _bytes(frame), count + 1
            if writer is None:
                size = (pixels.shape[1], pixels.shape[0])
                writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*"vp09"), FPS, size)
                if not writer.isOpened():
                    raise ValueError(f"{path}: expected OpenCV to encode VP9, found that it cannot; pip install av")
            if written is not None:
                written.result()
            written = pool.submit(writer.write, np.ascontiguousarray(pixels[..., ::-1]))
        if written is not None:
            written.result()
    if writer is not None:
        writer.release()
        _check_video(path, partial, count)
    return "VP9"


def _check_video(path: Path, partial: Path, frames: int) -> None:
    """Check the number of frames in the file: OpenCV does not report frames that it cannot write."""
    import cv2

    written = cv2.VideoCapture(str(partial))
    found = int(written.get(cv2.CAP_PROP_FRAME_COUNT)) if written.isOpened() else 0
    written.release()
    if found != frames:
        room = f"{shutil.disk_usage(path.parent).free / 1e6:.1f} MB of room"
        raise ValueError(f"{path}: expected a video of {frames} frames, found {found} written, with {room} on the disk")


def _bytes(frame: Float[Tensor, "h w 3"]) -> np.ndarray:
    return np.ascontiguousarray((frame.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
