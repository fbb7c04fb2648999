"""Images as tensors: reading and writing files, the sRGB transfer function, resampling."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageOps
from PIL.ExifTags import IFD
from torch import Tensor

from splatgraft.runtime.atomic_file import atomic_write

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"})
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
_ALWAYS_ALLOWED_PIXELS = 1 << 24
_PIXELS_PER_BYTE = 1 << 14
"""Above every real image: a black 1-bit PNG has 8256. Above 179 million pixels Pillow itself refuses."""
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])
"""Weights of linear rgb in luminance (Rec. 709)."""
_MEAN_PX = 256
"""Longest side from which a mean is taken of a file that can be read smaller than it is."""
_GREY_SCALES = {"I;16": 65535, "I;16B": 65535, "I;16L": 65535, "I;16N": 65535, "I": 65535, "F": 1}
"""White in Pillow's modes of more than 8 bits; some versions read a 16-bit PNG as mode I."""


def linear_from_srgb(srgb: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Linear light of display-referred values (IEC 61966-2-1); negative values are kept by odd symmetry."""
    magnitude = srgb.abs()
    linear = torch.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)
    return linear * srgb.sign()


def srgb_from_linear(linear: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Display-referred values of linear light; the inverse of `linear_from_srgb`."""
    magnitude = linear.abs()
    powered = 1.055 * magnitude.clamp_min(1e-8) ** (1 / 2.4) - 0.055
    return torch.where(magnitude <= 0.0031308, magnitude * 12.92, powered) * linear.sign()


def list_images(folder: Path) -> list[Path]:
    """Image files directly in `folder`, sorted by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))


def read_rgb(path: Path | str) -> Float[Tensor, "h w 3"]:
    """Read a picture as a viewer shows it, with EXIF rotation applied.

    Args:
        path: A .png, .jpg, .webp, .tif or .bmp file.

    Returns:
        sRGB in [0, 1]; transparent pixels are black.

    Raises:
        ValueError: The file is no readable image.
    """
    return _rgb(ImageOps.exif_transpose(_open(Path(path))))


def read_stored_rgb(path: Path) -> Float[Tensor, "h w 3"]:
    """sRGB in [0, 1] on the stored pixel grid, to which poses refer: COLMAP ignores EXIF rotation.

    Raises: ValueError where the file is no readable image.
    """
    return _rgb(_open(path))


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height of the stored pixel grid, without decoding it.

    Raises: ValueError where the file is no readable image.
    """
    with _opened(path) as image:
        return image.size


def mean_luminance(path: Path) -> float:
    """Mean linear luminance (Rec. 709) of a picture in [0, 1]; a JPEG is read at a small size.

    Raises: ValueError where the file is no readable image.
    """
    with _opened(path) as image:
        image.draft(None, (_MEAN_PX, _MEAN_PX))
        image.load()
        linear = linear_from_srgb(_rgb(image)).mean((0, 1))
    return float(linear @ LUMINANCE)


def read_grey(path: Path, longest_px: int) -> UInt8[np.ndarray, "h w"]:
    """Luma of a picture as a viewer shows it, at most `longest_px` long; a JPEG is decoded at a small size.

    Raises: ValueError where the file is no readable image.
    """
    with _opened(path) as image:
        image.draft(None, (longest_px, longest_px))
        image.load()
        grey = ImageOps.exif_transpose(image).convert("L")
        grey.thumbnail((longest_px, longest_px), Image.Resampling.BOX)
        return np.array(grey)


def read_exif(path: Path) -> dict[int, Any]:
    """The camera's EXIF tags of an image file, with Pillow's values; empty where there are none or they are damaged.

    Raises: ValueError where the file is no readable image.
    """
    with _opened(path) as image:
        try:
            return dict(image.getexif().get_ifd(IFD.Exif))
        except Exception:  # Pillow's parsers raise more kinds than it documents; damaged metadata tells nothing
            return {}


def has_transparency(path: Path) -> bool:
    """Whether the file has an alpha channel or a transparent colour, without decoding the pixels.

    Raises: ValueError where the file is no readable image.
    """
    with _opened(path) as image:
        return image.has_transparency_data


def read_alpha(path: Path) -> Float[Tensor, "h w"]:
    """The alpha channel in [0, 1] on the stored pixel grid; ones where the file has none.

    Raises: ValueError where the file is no readable image.
    """
    image = _open(path)
    if not image.has_transparency_data:
        return torch.ones(image.height, image.width)
    return torch.from_numpy(np.array(image.convert("RGBA").getchannel("A"))).float().div_(255)


def read_mask(path: Path) -> Float[Tensor, "h w"]:
    """Coverage in [0, 1] on the stored pixel grid: the alpha channel where the file has one that varies, else luma.

    Raises: ValueError where the file is no readable image.
    """
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
    """Modes that Pillow clips to 8 bits where it should scale."""
    values = np.array(image).astype(np.float32) / _GREY_SCALES[image.mode]
    return torch.from_numpy(np.nan_to_num(values)).clamp(0, 1)


def _open(path: Path) -> Image.Image:
    with _opened(path) as image:
        image.load()
        return image


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The opened image; all of Pillow's errors about a broken file become one ValueError."""
    if not path.is_file():
        raise ValueError(f"{path}: expected an image file, found none")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # odd metadata, and sizes that the next check refuses
            with Image.open(path, formats=_FORMATS) as image:
                if image.width * image.height > max(_ALWAYS_ALLOWED_PIXELS, _PIXELS_PER_BYTE * path.stat().st_size):
                    raise ValueError(f"{image.width}x{image.height} px claimed by {path.stat().st_size} bytes")
                yield image
    except Exception as error:  # Pillow's decoders raise more kinds than it documents (IndexError, struct.error, ..)
        raise ValueError(f"{path}: expected a readable image, found {type(error).__name__}: {error}") from error


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
    if path.suffix.lower() not in IMAGE_SUFFIXES or kind is None:
        raise ValueError(f"{path}: expected an image name that ends in {', '.join(sorted(IMAGE_SUFFIXES))}")
    array = (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, format=kind, **({"quality": 95} if kind == "JPEG" else {}))


def resize(image: Float[Tensor, "h w *c"], width: int, height: int) -> Float[Tensor, "j i *c"]:
    """Resampled by area where it shrinks, bilinearly where it grows."""
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    shrinks = width < image.shape[1] or height < image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    resized = cv2.resize(image.contiguous().numpy(), (width, height), interpolation=method)
    return torch.from_numpy(resized).reshape(height, width, *image.shape[2:])  # OpenCV drops a single channel's axis
