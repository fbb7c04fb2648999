"""Photos made ready for structure from motion, grouped by camera, and freed of distortion after it."""

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base

from splatgraft.core.distortion import Distortion
from splatgraft.core.images import read_rgb
from splatgraft.formats.captures.exif import exif_of, read_exposure
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


def camera_groups(copies: Sequence[Path], shared: bool) -> list[list[str]]:
    """File names of the photos that have one camera: equal size and EXIF maker, model and focal length.

    Args:
        copies: Working copies.
        shared: Whether photos share cameras at all; else each is a group.

    Returns:
        Groups in the order of their first photos.
    """
    if not shared:
        return [[copy.name] for copy in copies]
    groups: dict[tuple[object, ...], list[str]] = {}
    for copy in copies:
        groups.setdefault(_camera_traits(copy), []).append(copy.name)
    return list(groups.values())


def _camera_traits(copy: Path) -> tuple[object, ...]:
    with Image.open(copy) as image:
        exif = image.getexif()
        details = exif.get_ifd(IFD.Exif)
        focal = (details.get(Base.FocalLength), details.get(Base.FocalLengthIn35mmFilm))
        return (image.size, exif.get(Base.Make), exif.get(Base.Model), *(f and float(f) for f in focal))


def write_undistorted(copy: Path, path: Path, distortion: Distortion) -> torch.Tensor:
    """Write the pinhole image of `copy` as JPEG with its exposure metadata, and give that pinhole's matrix (3, 3)."""
    width, height = distortion.size
    intrinsics = torch.from_numpy(distortion.pinhole())
    pixels = distortion.undistort(read_rgb(copy), intrinsics, width=width, height=height)
    array = (pixels.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, "JPEG", quality=95, subsampling=0, exif=exif_of(read_exposure(copy)))
    return intrinsics.float()
