"""Images as tensors: reading and writing files, sRGB transfer, resampling. Knows nothing about cameras or Gaussians."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from splatgraft.whole_file import whole_file

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"})
_EXIF_ORIENTATION = 0x0112
_EXIF_SWAPS_SIDES = frozenset({5, 6, 7, 8})
_UNREADABLE = (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError)


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


def read_rgb(path: Path) -> Float[Tensor, "h w 3"]:
    """sRGB in [0, 1]; EXIF rotation applied, alpha dropped.

    Raises: ValueError where the file is no readable image.
    """
    return torch.from_numpy(np.array(_open(path).convert("RGB"))).float() / 255


def read_alpha(path: Path) -> Float[Tensor, "h w"]:
    """The alpha channel in [0, 1]; ones where the file has none.

    Raises: ValueError where the file is no readable image.
    """
    image = _open(path)
    if not image.has_transparency_data:
        return torch.ones(image.height, image.width)
    return torch.from_numpy(np.array(image.convert("RGBA").getchannel("A"))).float() / 255


def image_size(path: Path) -> tuple[int, int]:
    """Width and height after EXIF rotation, without decoding the pixels.

    Raises: ValueError where the file is no readable image.
    """
    try:
        with Image.open(path) as image:
            turned = image.getexif().get(_EXIF_ORIENTATION) in _EXIF_SWAPS_SIDES
            return (image.height, image.width) if turned else image.size
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def read_mask(path: Path) -> Float[Tensor, "h w"]:
    """Coverage in [0, 1]: the alpha channel where the file has one that varies, else luma.

    Raises: ValueError where the file is no readable image.
    """
    image = _open(path)
    if image.mode in ("RGBA", "LA"):
        alpha = np.array(image.getchannel("A"))
        if alpha.min() < alpha.max():
            return torch.from_numpy(alpha).float() / 255
    if image.mode == "P":
        image = image.convert("RGB")
    if image.mode.startswith("I"):
        values = np.array(image).astype(np.float32)
        return torch.from_numpy(values / max(float(values.max()), 1.0))
    return torch.from_numpy(np.array(image.convert("L"))).float() / 255


def has_transparency(path: Path) -> bool:
    """Whether the file has an alpha channel or a transparent colour, without decoding the pixels.

    Raises: ValueError where the file is no readable image.
    """
    try:
        with Image.open(path) as image:
            return image.has_transparency_data
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def _open(path: Path) -> Image.Image:
    try:
        with Image.open(path) as image:
            return ImageOps.exif_transpose(image)
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ValueError:
    if not path.is_file():
        return ValueError(f"{path}: expected an image file, found none")
    return ValueError(f"{path}: expected a readable image, found {type(error).__name__}: {error}")


def write_image(path: Path, image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"]) -> None:
    """Write 8-bit sRGB or grey; the format follows the suffix. The file appears whole or not at all.

    Raises: ValueError where the suffix names no image format.
    """
    kind = Image.registered_extensions().get(path.suffix.lower())
    if path.suffix.lower() not in IMAGE_SUFFIXES or kind is None:
        raise ValueError(f"{path}: expected an image name that ends in {', '.join(sorted(IMAGE_SUFFIXES))}")
    array = (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with whole_file(path) as stream:
        Image.fromarray(array).save(stream, format=kind, **({"quality": 95} if kind == "JPEG" else {}))


def resize(image: Float[Tensor, "h w *c"], width: int, height: int) -> Float[Tensor, "j i *c"]:
    """Resampled by area where it shrinks, bilinearly where it grows."""
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    shrinks = width < image.shape[1] or height < image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return torch.from_numpy(cv2.resize(image.contiguous().numpy(), (width, height), interpolation=method))
