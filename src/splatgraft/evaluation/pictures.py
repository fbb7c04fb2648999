"""Pictures for reports: labelled images side by side, animations, and maps of the change of light in a view."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from splatgraft.evaluation.measure import SHADOW_RATIO, luminance_ratio
from splatgraft.runtime.files import atomic_write

_GAP_PX = 6


def side_by_side(images: Sequence[Float[Tensor, "h _ 3"]], labels: Sequence[str]) -> Float[Tensor, "h _ 3"]:
    """Join images of one height in a row with thin white gaps, each with its label in the lower left corner."""
    height = images[0].shape[0]
    gap = torch.ones(height, max(2, height * _GAP_PX // 480), 3)
    parts: list[Tensor] = []
    for image, label in zip(images, labels, strict=True):
        parts += [_labelled(image, label), gap]
    return torch.cat(parts[:-1], 1)


def write_animation(
    path: Path, frames: Sequence[Float[Tensor, "h w 3"]], *, fps: float = 20.0, max_bytes: int = 6_000_000
) -> None:
    """Write a looping .gif (one palette, dithered) or .webp, scaled down until it has at most `max_bytes`."""
    if path.suffix not in (".gif", ".webp") or not frames:
        raise ValueError(f"{path}: expected .gif or .webp and at least one frame, found {len(frames)} frames")
    encode = _gif if path.suffix == ".gif" else _webp
    pictures = [_pil(frame) for frame in frames]
    data = encode(pictures, fps)
    while len(data) > max_bytes and pictures[0].width > 16:
        # the size in bytes is about proportional to the area; with a margin of 0.95 one or two rounds suffice
        factor = 0.95 * math.sqrt(max_bytes / len(data))
        size = (max(16, int(pictures[0].width * factor)), max(1, int(pictures[0].height * factor)))
        pictures = [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures]
        data = encode(pictures, fps)
    with atomic_write(path) as stream:
        stream.write(data)


def _pil(image: Float[Tensor, "h w 3"]) -> Image.Image:
    return Image.fromarray((image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())


def _labelled(image: Float[Tensor, "h w 3"], label: str) -> Float[Tensor, "h w 3"]:
    picture = _pil(image).convert("RGBA")
    size = max(11, picture.height // 20)
    font = ImageFont.load_default(size)
    layer = Image.new("RGBA", picture.size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    left, top, right, bottom = draw.textbbox((0, 0), label, font=font)
    pad, margin = size * 0.45, size * 0.6
    box_height = (bottom - top) + 2 * pad
    y = picture.height - margin - box_height
    draw.rounded_rectangle(
        (margin, y, margin + (right - left) + 2 * pad, y + box_height), radius=pad, fill=(16, 18, 22, 170)
    )
    draw.text((margin + pad - left, y + pad - top), label, font=font, fill=(255, 255, 255, 255))
    joined = Image.alpha_composite(picture, layer).convert("RGB")
    return torch.from_numpy(np.array(joined)).float() / 255


def _gif(pictures: Sequence[Image.Image], fps: float) -> bytes:
    # one palette for all frames, made from several: no flicker, and a smaller file
    samples = pictures[:: max(1, len(pictures) // 8)]
    sheet = Image.new("RGB", (samples[0].width, samples[0].height * len(samples)))
    for i, picture in enumerate(samples):
        sheet.paste(picture, (0, i * picture.height))
    palette = sheet.quantize(256, method=Image.Quantize.MEDIANCUT)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for picture in pictures]
    # GIF stores durations in hundredths of a second
    return _animated(frames, "GIF", duration=max(2, round(100 / fps)) * 10, optimize=False, disposal=1)


def _webp(pictures: Sequence[Image.Image], fps: float) -> bytes:
    return _animated(pictures, "WEBP", duration=round(1000 / fps), quality=85, method=4)


def _animated(frames: Sequence[Image.Image], kind: str, *, duration: int, **settings: int | bool) -> bytes:
    buffer = io.BytesIO()
    frames[0].save(buffer, kind, save_all=True, append_images=list(frames[1:]), loop=0, duration=duration, **settings)
    return buffer.getvalue()


_DARKER = torch.tensor([0.16, 0.32, 0.78])
_BRIGHTER = torch.tensor([0.93, 0.55, 0.10])
_UNCHANGED = torch.tensor([0.93, 0.93, 0.93])
_NOISE_STOPS = 0.02  # photographic stops: the noise between two renders; smaller changes stay grey in the change map
_FULL_COLOR_STOPS = 1.0  # photographic stops at which the change map has its full colours; set by hand
_EXPONENT = 0.7  # exponent of the change map's colours; below 1, faint shadows stay visible beside strong ones


def describe_change(
    result: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]
) -> dict[str, float]:
    """Describe how the luminance of `result` differs from copy-paste, given the coverage by the object.

    object_brightness: mean ratio of linear luminance on the object; 1 if the view shows no object.
    darkened_fraction, brightened_fraction: shares of the pixels off the object that lost or gained more than 5% of
    their luminance.
    """
    ratio = luminance_ratio(result, composite)
    inside, outside = mask > 0.5, mask <= 0
    surroundings = ratio[outside]
    return {
        "object_brightness": float(ratio[inside].mean()) if bool(inside.any()) else 1.0,
        "darkened_fraction": float((surroundings < SHADOW_RATIO).float().mean()) if len(surroundings) else 0.0,
        "brightened_fraction": float((surroundings > 1 / SHADOW_RATIO).float().mean()) if len(surroundings) else 0.0,
    }


def change_map(result: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Draw where `result` is darker (blue) or brighter (orange) than `composite`, sRGB in [0, 1]."""
    full, noise = _FULL_COLOR_STOPS, _NOISE_STOPS
    stops = luminance_ratio(result, composite).clamp_min(1e-3).log2().clamp(-full, full)[..., None]
    tint = torch.where(stops < 0, _DARKER, _BRIGHTER)
    strength = ((stops.abs() - noise).clamp_min(0) / (full - noise)) ** _EXPONENT
    return _UNCHANGED + strength * (tint - _UNCHANGED)
