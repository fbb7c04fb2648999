"""Captures of generated photos: noise with the spectrum of photographs, cameras on a ring."""

from pathlib import Path
from typing import Any

import numpy as np
import shapes
import torch
from PIL import Image
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats import write_capture

SIZE = (160, 120)


def texture(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Return (h, w, 3) bytes of 1/f noise, the spectrum of photographs."""
    width, height = size
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency[0, 0] = 1
    total = np.fft.irfft2(np.fft.rfft2(noise, axes=(0, 1)) / frequency[..., None], s=(height, width), axes=(0, 1))
    return (128 + 40 * total / total.std()).clip(0, 255).astype(np.uint8)


def ring(count: int) -> Cameras:
    return shapes.ring(count, height=1.0, radius=2.0, focal=150.0, size=SIZE)


def write_photos(folder: Path, count: int, suffix: str = ".png") -> list[Path]:
    folder.mkdir(parents=True)
    paths = [folder / f"{i:04d}{suffix}" for i in range(count)]
    for i, path in enumerate(paths):
        Image.fromarray(texture(i)).save(path)
    return paths


def write_posed(folder: Path, count: int = 10, *, masks: bool = False) -> list[Path]:
    """Write a capture with transforms.json and masks/ of discs, and return the photos."""
    paths = write_photos(folder / "images", count)
    if masks:
        (folder / "masks").mkdir()
        for path in paths:
            Image.fromarray(disc()).save(folder / "masks" / path.name)
    points = 0.3 * torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
    posed = PosedImages(
        image_paths=tuple(paths), cameras=ring(count), points=points, point_colors=torch.full((60, 3), 0.5)
    )
    write_capture(folder, posed)
    return paths


def disc() -> np.ndarray:
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.where((u - 80) ** 2 + (v - 60) ** 2 < 900, 255, 0).astype(np.uint8)


def colmap_answer(names: list[str], poses: Tensor, size: tuple[int, int], **figures: Any) -> dict[str, Any]:
    """Return the answer of the COLMAP process: photos of one lens with these poses (n, 4, 4)."""
    width, height = size
    focal = 1.25 * width
    images = [
        {
            "name": name,
            "world_from_camera": pose[:3].tolist(),
            "camera": [focal, focal, width / 2, height / 2, 0.01, 0.0, 0.0, 0.0],
            "camera_id": 1,
            "observations": 500,
        }
        for name, pose in zip(names, poses, strict=True)
    ]
    photos = [{"name": name, "features": 900, "matches": 400, "moved": False} for name in names]
    fixed = {"models": 1, "method": "global", "explained": 0.8, "mean_reprojection_px": 0.4, "points": []}
    return fixed | {"seconds": {}, "cpu_seconds": {}, "photos": photos, "agreements": [], "images": images} | figures
