"""Images as tensors: reading and writing files, the sRGB transfer function, resampling.

Every reader raises ValueError if the file is no readable image.
"""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base
from torch import Tensor

from splatgraft.runtime.files import atomic_write

WRITTEN_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"})
_HEIF_SUFFIXES = frozenset({".heic", ".heif"})
IMAGE_SUFFIXES = WRITTEN_SUFFIXES | _HEIF_SUFFIXES
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
_TURNED_SIDEWAYS = (5, 6, 7, 8)  # EXIF orientations that exchange width and height
_FROM_RIGHT, _FROM_BELOW = (2, 3, 7, 8), (3, 4, 6, 7)
"""EXIF orientations whose stored columns, or rows, run opposite to those of the upright image."""
_ALWAYS_ALLOWED_PIXELS = 1 << 24  # pixels that a file of any length may have
_PIXELS_PER_BYTE = 1 << 14
"""Bound above every real image: a black 1-bit PNG has 8256. Pillow itself refuses more than 179 million pixels."""
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])
"""Luminance weights of linear RGB (Rec. 709)."""
_GREY_SCALES = {"I;16": 65535, "I;16B": 65535, "I;16L": 65535, "I;16N": 65535, "I": 65535, "F": 1}
"""White level of Pillow's modes of more than 8 bits; some versions read a 16-bit PNG as mode I."""


def linear_from_srgb(srgb: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Decode sRGB to linear light (IEC 61966-2-1); negative values by odd symmetry."""
    magnitude = srgb.abs()
    linear = torch.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)
    return linear * srgb.sign()


def srgb_from_linear(linear: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Encode linear light as sRGB; the inverse of `linear_from_srgb`."""
    magnitude = linear.abs()
    powered = 1.055 * magnitude.clamp_min(1e-8) ** (1 / 2.4) - 0.055
    return torch.where(magnitude <= 0.0031308, magnitude * 12.92, powered) * linear.sign()


def list_images(folder: Path) -> list[Path]:
    """List the image files directly in `folder`, sorted by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))


def read_rgb(path: Path | str) -> Float[Tensor, "h w 3"]:
    """Read a picture as a viewer shows it, with EXIF rotation applied.

    Args:
        path: A .png, .jpg, .webp, .tif, .bmp or, with the extra `heic`, .heic file.

    Returns:
        sRGB in [0, 1]; transparent pixels are black.

    Raises:
        ValueError: The file is no readable image.
    """
    return _rgb(ImageOps.exif_transpose(_open(Path(path))))


def read_straight_rgb(path: Path) -> Float[Tensor, "h w 3"]:
    """Read sRGB in [0, 1] as stored, without alpha; soft edges have their full colour (straight alpha)."""
    image = _open(path)
    if not image.has_transparency_data:
        return _rgb(image)
    return torch.from_numpy(np.array(image.convert("RGBA"))[..., :3].copy()).float().div_(255)


def read_stored_rgb(
    path: Path, size: tuple[int, int] | None = None, *, longest_px: int | None = None
) -> Float[Tensor, "h w 3"]:
    """Read sRGB in [0, 1] on the stored pixel grid; poses refer to it, because COLMAP ignores EXIF rotation.

    Other programs apply EXIF rotation: the image is turned if that alone gives it the shape of the camera's `size`. A
    picture longer than `longest_px` is reduced to it; a JPEG is then decoded at a reduced size.
    """
    with opened(path) as image:
        if longest_px is not None:
            shrink_on_decoding(image, longest_px)
        sideways = size is not None and _is_sideways(image, size)
        pixels = _rgb(ImageOps.exif_transpose(image) if sideways else image)
    height, width = pixels.shape[:2]
    factor = 1.0 if longest_px is None else min(1.0, longest_px / max(width, height))
    return resize(pixels, max(1, round(width * factor)), max(1, round(height * factor)))


def stored_size(path: Path, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """Return width and height of the grid that `read_stored_rgb` reads at full size, without decoding."""
    with opened(path) as image:
        width, height = image.size
        return (height, width) if size is not None and _is_sideways(image, size) else (width, height)


def stored_points(
    path: Path, points: Float[Tensor, "n 2"], size: tuple[int, int] | None = None
) -> Float[Tensor, "n 2"]:
    """Map points of the upright picture, pixels, to the grid that `read_stored_rgb` reads for `size`."""
    with opened(path) as image:
        orientation = 1 if size is not None and _is_sideways(image, size) else _exif_orientation(image)
        width, height = image.size
    x, y = points.unbind(1)
    if orientation in _TURNED_SIDEWAYS:
        x, y = y, x
    x = width - x if orientation in _FROM_RIGHT else x
    y = height - y if orientation in _FROM_BELOW else y
    return torch.stack([x, y], 1)


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have the same aspect ratio, with sides rounded to whole pixels."""
    # with both sides scaled by one factor and rounded, the cross products differ by at most one longer side
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def _is_sideways(image: Image.Image, size: tuple[int, int]) -> bool:
    """Whether the image has the shape of `size` only after EXIF rotation."""
    if same_shape(image.size, size) or not same_shape((image.height, image.width), size):
        return False
    return _exif_orientation(image) in _TURNED_SIDEWAYS


def _exif_orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) if it is missing."""
    try:
        return image.getexif().get(Base.Orientation, 1)
    except Exception:  # as in read_exif
        return 1


def shrink_on_decoding(image: Image.Image, longest_px: int) -> None:
    """Make a JPEG decode at a half, quarter or eighth of its size, at least twice `longest_px` long.

    The factor of two leaves the final reduction to a better filter.
    """
    factor = 2 * longest_px / max(image.size)
    if factor < 1:
        image.draft(None, (math.ceil(image.width * factor), math.ceil(image.height * factor)))


def read_grey(path: Path, longest_px: int) -> UInt8[np.ndarray, "h w"]:
    """Read the luma of the upright picture, at most `longest_px` long; a JPEG is decoded at a small size."""
    with opened(path) as image:
        image.draft(None, (longest_px, longest_px))
        image.load()
        grey = ImageOps.exif_transpose(image).convert("L")
        grey.thumbnail((longest_px, longest_px), Image.Resampling.BOX)
        return np.array(grey)


def read_upright(path: Path, longest_px: int) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[int, int]]:
    """Read the upright picture, at most `longest_px` long, and return its full width and height as well."""
    with opened(path) as image:
        width, height = image.size
        size = (height, width) if _exif_orientation(image) in _TURNED_SIDEWAYS else (width, height)
        shrink_on_decoding(image, longest_px)
        image.load()
        upright = ImageOps.exif_transpose(image)
    pixels = (_rgb(upright) * 255).round().to(torch.uint8).numpy()
    small = Image.fromarray(pixels)
    small.thumbnail((longest_px, longest_px), Image.Resampling.LANCZOS)
    return np.array(small), size


def read_exif(path: Path, *, part: IFD = IFD.Exif) -> dict[int, Any]:
    """Read the EXIF tags of the camera or of another part, with Pillow's values; empty if none or damaged."""
    with opened(path) as image:
        try:
            return dict(image.getexif().get_ifd(part))
        except Exception:  # Pillow's parsers raise more kinds than it documents; damaged metadata counts as none
            return {}


def has_transparency(path: Path) -> bool:
    """Whether the file has an alpha channel or a transparent colour, without decoding the pixels."""
    with opened(path) as image:
        return image.has_transparency_data


def read_alpha(path: Path, size: tuple[int, int] | None = None) -> Float[Tensor, "h w"]:
    """Read the alpha channel in [0, 1] on the pixel grid of `read_stored_rgb`; ones if the file has none."""
    image = _open(path)
    if size is not None and _is_sideways(image, size):
        image = ImageOps.exif_transpose(image)
    if not image.has_transparency_data:
        return torch.ones(image.height, image.width)
    return torch.from_numpy(np.array(image.convert("RGBA").getchannel("A"))).float().div_(255)


def read_mask(path: Path) -> Float[Tensor, "h w"]:
    """Read coverage in [0, 1] on the stored pixel grid: the alpha channel if it varies, else luma."""
    image = _open(path)
    if image.has_transparency_data:
        alpha = np.array(image.convert("RGBA").getchannel("A"))
        if alpha.min() < alpha.max():
            return torch.from_numpy(alpha).float().div_(255)
    if image.mode in _GREY_SCALES:
        return _grey(image)
    return torch.from_numpy(np.array(image.convert("RGB").convert("L"))).float().div_(255)


def _rgb(image: Image.Image) -> Float[Tensor, "h w 3"]:
    if image.mode in _GREY_SCALES:
        return _grey(image)[..., None].expand(-1, -1, 3).contiguous()
    if not image.has_transparency_data:
        return torch.from_numpy(np.array(image.convert("RGB"))).float().div_(255)
    values = torch.from_numpy(np.array(image.convert("RGBA"))).float().div_(255)
    return values[..., :3] * values[..., 3:]


def _grey(image: Image.Image) -> Float[Tensor, "h w"]:
    """Scale a mode of more than 8 bits, which Pillow would clip."""
    values = np.array(image).astype(np.float32) / _GREY_SCALES[image.mode]
    return torch.from_numpy(np.nan_to_num(values)).clamp(0, 1)


def _open(path: Path) -> Image.Image:
    with opened(path) as image:
        image.load()
        return image


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """Open an image without decoding it; every error of Pillow's about a broken file becomes a ValueError."""
    if not path.is_file():
        raise ValueError(f"{path}: expected an image file, found none")
    formats = (*_FORMATS, "HEIF") if _with_heif(path) else _FORMATS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # odd metadata, and sizes that the next check refuses
            with Image.open(path, formats=formats) as image:
                if image.width * image.height > max(_ALWAYS_ALLOWED_PIXELS, _PIXELS_PER_BYTE * path.stat().st_size):
                    raise ValueError(f"{image.width}x{image.height} px claimed by {path.stat().st_size} bytes")
                yield image
    except Exception as error:  # Pillow's decoders raise more kinds than it documents (IndexError, struct.error, ..)
        raise ValueError(f"{path}: expected a readable image, found {type(error).__name__}: {error}") from error


def _with_heif(path: Path) -> bool:
    """Load Pillow's HEIF plugin if the suffix asks for it; returns whether it does."""
    if path.suffix.lower() not in _HEIF_SUFFIXES:
        return False
    if find_spec("pillow_heif") is None:
        raise ValueError(f"{path}: expected pillow-heif to read HEIC (pip install 'splatgraft[heic]'), found none")
    import pillow_heif

    pillow_heif.register_heif_opener()
    return True


_WRITE_OPTIONS = {"JPEG": {"quality": 95}, "PNG": {"compress_level": 1}}
"""Options by Pillow's name of the format; level 6, its own, takes a PNG four times as long for a tenth less space."""


def write_image(path: Path | str, image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"]) -> None:
    """Write 8-bit sRGB or grey in the format of the suffix; the file appears whole or not at all.

    Args:
        path: A file that ends in .png, .jpg, .webp, .tif or .bmp.
        image: Values in [0, 1]; others are clamped.

    Raises:
        ValueError: The suffix names no image format.
    """
    path = Path(path)
    kind = Image.registered_extensions().get(path.suffix.lower())
    if path.suffix.lower() not in WRITTEN_SUFFIXES or kind is None:
        raise ValueError(f"{path}: expected an image name that ends in {', '.join(sorted(WRITTEN_SUFFIXES))}")
    array = (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, format=kind, **_WRITE_OPTIONS.get(kind, {}))


def write_radiance(path: Path | str, radiance: Float[Tensor, "h w 3"]) -> None:
    """Write linear rgb as a Radiance .hdr, rounded to 8 bits of each pixel's largest channel.

    Args:
        path: A file that ends in .hdr; it appears whole or not at all.
        radiance: Linear rgb, at least 0.

    Raises:
        ValueError: The name has another suffix.
    """
    path = Path(path)
    if path.suffix.lower() != ".hdr":
        raise ValueError(f"{path}: expected a name that ends in .hdr, found {path.name}")
    encoded, data = cv2.imencode(".hdr", np.ascontiguousarray(radiance.flip(-1).numpy()))
    assert encoded
    with atomic_write(path) as stream:
        stream.write(data.tobytes())


def resize(image: Float[Tensor, "h w *c"], width: int, height: int) -> Float[Tensor, "j i *c"]:
    """Resample by area if a side shrinks, else bilinearly."""
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    shrinks = width < image.shape[1] or height < image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    resized = cv2.resize(image.contiguous().numpy(), (width, height), interpolation=method)
    return torch.from_numpy(resized).reshape(height, width, *image.shape[2:])  # OpenCV drops a single channel's axis
