"""Pictures of a scene: one from the first view, or a turntable."""

from collections.abc import Iterator
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
from splatgraft.exports.first_view import FirstView
from splatgraft.exports.turntable_video import FPS, write_video
from splatgraft.rendering import render
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.progress import Progress, silent


def write_picture(path: Path, gaussians: Gaussians, view: FirstView, *, width: int, with_alpha: bool) -> None:
    """Write the first view.

    Args:
        path: A .png or .jpg.
        gaussians: The scene.
        view: The camera.
        width: Pixels.
        with_alpha: Whether a .png gets the opacity as alpha, with straight colours, instead of black behind the scene.
    """
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
    """Write what the cameras of a path see as .mp4, .gif or .webp; gives a sentence on it.

    Raises:
        ValueError: The encoder does not start.
    """
    frames = len(cameras)
    if path.suffix.lower() == ".mp4":
        codec = write_video(path, _drawn(gaussians, cameras, progress))
        return f"{frames / FPS:.1f} s of {cameras.width} x {cameras.height} in {codec}"
    write_animation(path, list(_drawn(gaussians, cameras, progress)), fps=float(FPS))
    return f"{frames / FPS:.1f} s, scaled down where it would be larger than 6 MB"


def _drawn(gaussians: Gaussians, cameras: Cameras, progress: Progress) -> Iterator[Float[Tensor, "h w 3"]]:
    for index, camera in enumerate(cameras):
        progress(index, len(cameras), "pictures")
        yield render(gaussians, camera).color[0].clamp(0, 1)
    progress(len(cameras), len(cameras), "pictures")
