"""Photos made ready for structure from motion, and freed of distortion after it. Knows nothing about poses."""

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageOps

from splatgraft.core.distortion import Distortion
from splatgraft.core.images import read_rgb
from splatgraft.runtime.atomic_file import atomic_write

_EXIF_ORIENTATION = 0x0112


def working_copies(photos: Sequence[Path], folder: Path, max_size_px: int) -> list[Path]:
    """Upright copies, at most `max_size_px` on the longest side, that keep the EXIF focal length.

    Raises: ValueError where two photos have one name, or one cannot be read.
    """
    names = [photo.stem + ".jpg" for photo in photos]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{photos[0].parent}: expected one photo per name, found several of {Path(twice[0]).stem!r}")
    folder.mkdir(parents=True, exist_ok=True)
    for photo, name in zip(photos, names, strict=True):
        read_rgb(photo)  # the one place that words the errors of unreadable images
        with Image.open(photo) as image:
            exif = image.getexif()
            copy = ImageOps.exif_transpose(image).convert("RGB")
        exif[_EXIF_ORIENTATION] = 1
        copy.thumbnail((max_size_px, max_size_px), Image.Resampling.LANCZOS)
        copy.save(folder / name, quality=97, subsampling=0, exif=exif)
    return [folder / name for name in names]


def camera_mode(copies: Sequence[Path], shared: bool) -> str:
    """COLMAP's word for which photos share a camera; one camera needs one size."""
    if not shared:
        return "PER_IMAGE"
    sizes = set()
    for copy in copies:
        with Image.open(copy) as image:
            sizes.add(image.size)
    return "SINGLE" if len(sizes) == 1 else "AUTO"


def write_undistorted(copy: Path, path: Path, distortion: Distortion) -> torch.Tensor:
    """Write the pinhole image of `copy` as JPEG, and give the matrix (3, 3) of that pinhole."""
    width, height = distortion.size
    intrinsics = torch.from_numpy(distortion.pinhole())
    pixels = distortion.undistort(read_rgb(copy), intrinsics, width=width, height=height)
    array = (pixels.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, "JPEG", quality=95, subsampling=0)
    return intrinsics.float()
