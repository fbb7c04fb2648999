"""Photos before and after structure from motion: reduced upright copies, groups by camera, undistorted images."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base
from torch import Tensor

from splatgraft.core.distortion import Distortion
from splatgraft.core.images import opened, read_mask, read_rgb, shrink_on_decoding, stored_size, write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.exif import exif_of, read_exposure
from splatgraft.formats.captures.masks import check_mask
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.progress import Progress, silent


def working_copies(photos: Sequence[Path], folder: Path, max_size_px: int) -> list[Path]:
    """Write upright copies with their EXIF data, at most `max_size_px` on the longest side.

    Raises:
        ValueError: Two photos have the same name.
    """
    names = [photo.stem + ".jpg" for photo in photos]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{photos[0].parent}: expected one photo per name, found several {Path(twice[0]).stem!r}")
    folder.mkdir(parents=True, exist_ok=True)
    for photo, name in zip(photos, names, strict=True):
        with opened(photo) as image:
            exif = _saved_exif(image)
            shrink_on_decoding(image, max_size_px)
            copy = _on_black(ImageOps.exif_transpose(image))
        copy.thumbnail((max_size_px, max_size_px), Image.Resampling.LANCZOS)
        copy.save(folder / name, quality=97, subsampling=0, exif=exif)
    return [folder / name for name in names]


def _on_black(image: Image.Image) -> Image.Image:
    """Convert to RGB, with transparent pixels black (like `read_rgb`)."""
    if not image.has_transparency_data:
        return image.convert("RGB")
    image = image.convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image).convert("RGB")


def working_masks(masks: Sequence[Path | None], copies: Sequence[Path], folder: Path) -> dict[str, Path]:
    """Write masks in COLMAP's form: NAME.jpg.png, the size of the copy, black where features are ignored.

    A mask file is already upright. A mask in the alpha channel of a photo is turned by the photo's EXIF orientation.

    Returns:
        Masks by the name of their copy.
    """
    written: dict[str, Path] = {}
    for mask, copy in zip(masks, copies, strict=bool(masks)):
        if mask is None:
            continue
        folder.mkdir(parents=True, exist_ok=True)
        coverage = Image.fromarray((read_mask(mask) * 255).round().to(torch.uint8).numpy())
        size = stored_size(copy)
        with Image.open(mask) as stored:
            orientation = stored.getexif().get(Base.Orientation, 1)
        if orientation == 1:
            check_mask(mask, size)
        coverage.getexif()[Base.Orientation] = orientation
        coverage = ImageOps.exif_transpose(coverage)
        written[copy.name] = folder / f"{copy.name}.png"
        coverage.resize(size, Image.Resampling.BOX).save(written[copy.name])
    return written


def _saved_exif(image: Image.Image) -> bytes:
    """Return the EXIF data for an upright copy, empty if damaged."""
    try:
        exif = image.getexif()
        exif[Base.Orientation] = 1
        return exif.tobytes()
    except Exception:  # Pillow's parsers and writers raise more kinds than it documents
        return b""


def camera_groups(copies: Sequence[Path], shared: bool) -> list[list[str]]:
    """Group the file names of working copies by camera.

    If `shared`, photos of equal size and EXIF (maker, model, focal length) share a camera. Otherwise each has its own.
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


def write_undistorted(
    copy: Path, path: Path, distortion: Distortion, *, mask: tuple[Path, Path] | None = None, quarters: int = 0
) -> Float[Tensor, "3 3"]:
    """Undistort a photo and its mask, turn them, and write them as JPEG with exposure metadata and as PNG.

    Args:
        copy: Photo to undistort.
        path: JPEG to write.
        distortion: Lens of the photo.
        mask: Mask to undistort, and PNG to write.
        quarters: Counterclockwise quarter turns.

    Returns:
        Intrinsics of the undistorted image before it is turned, pixels.
    """
    width, height = distortion.size
    intrinsics = torch.from_numpy(distortion.pinhole())
    image = distortion.undistort(read_rgb(copy), intrinsics, width=width, height=height)
    _write_jpeg(path, torch.rot90(image, quarters), copy)
    if mask is not None:
        coverage = read_mask(mask[0])[..., None].expand(-1, -1, 3)
        seen = distortion.undistort(coverage, intrinsics, width=width, height=height)[..., 0]
        write_image(mask[1], torch.rot90(seen, quarters))
    return intrinsics.float()


def write_reduced(posed: PosedImages, folder: Path, longest_px: int, *, progress: Progress = silent) -> PosedImages:
    """Limit the longest side of a capture's images to `longest_px`.

    Larger images are undistorted, reduced and written to `folder`. Smaller ones keep their files.
    """
    limited = posed.limited(longest_px)
    stems = [Path(name).stem for name in posed.cameras.names]
    images, masks = list(limited.image_paths), list(limited.mask_paths)
    distortions = list(limited.distortions)
    for index, (photo, size) in enumerate(zip(posed.image_paths, limited.cameras.sizes.tolist(), strict=True)):
        if max(stored_size(photo, (size[0], size[1]))) <= longest_px:
            continue
        stem = stems[index] if stems.count(stems[index]) == 1 else posed.cameras.names[index]
        images[index] = folder / "images" / f"{stem}.jpg"
        images[index].parent.mkdir(exist_ok=True)
        _write_jpeg(images[index], limited.reduced_image(index), photo)
        mask = limited.mask(index)
        if mask is not None:
            masks[index] = path = folder / "masks" / f"{stem}.png"
            path.parent.mkdir(exist_ok=True)
            write_image(path, mask)
        if distortions:
            distortions[index] = None
        progress(index + 1, len(posed), "reducing photos")
    return replace(
        limited,
        image_paths=tuple(images),
        mask_paths=tuple(masks),
        distortions=tuple(distortions) if any(distortions) else (),
    )


def _write_jpeg(path: Path, pixels: Float[Tensor, "h w 3"], photo: Path) -> None:
    """Write sRGB in [0, 1] as JPEG with the exposure metadata of `photo`."""
    array = (pixels.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, "JPEG", quality=95, subsampling=0, exif=exif_of(read_exposure(photo)))
