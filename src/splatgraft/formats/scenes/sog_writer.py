"""Writes SOG scenes (PlayCanvas, version 2): lossless WebP pictures and meta.json in a zip.

The Gaussians are sorted along a Morton curve, so that neighbours in the pictures are neighbours in space and compress
well. `sog` reads the result and describes the fields.
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.code_book import nearest_codes, palette, scalar_codes
from splatgraft.formats.scenes.morton_order import morton_order
from splatgraft.formats.scenes.quantized import bytes_from_unit, smallest_three, writable
from splatgraft.formats.scenes.scene_metadata import SceneMetadata
from splatgraft.formats.scenes.sog_container import META_FILE
from splatgraft.runtime.atomic_file import atomic_write

_PALETTE_COLUMNS = 64
_LARGEST_PALETTE = 1 << 16
_GAUSSIANS_PER_ENTRY = 4
"""Of the palette of SH bands; by size and PSNR of the demo's scenes."""
_SMALLEST_PALETTE = 1 << 10
_SQRT2 = 2**0.5
_FIRST_TAG = 252
_DATE = (1980, 1, 1, 0, 0, 0)


def write_sog(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write version 2: positions in 16 bits of their logarithm, scales and colours by tables, bands by a palette.

    Raises: ValueError where there are no Gaussians, or some are not finite.
    """
    with atomic_write(path) as stream:
        stream.write(encode_sog(path, gaussians, metadata))


def encode_sog(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> bytes:
    """The bytes of a .sog; `path` is for messages.

    Raises: ValueError where there are no Gaussians, or some are not finite.
    """
    g = writable(path, gaussians, ".sog")
    g = g.select(morton_order(g.means))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "splatgraft"},
        "count": g.count,
        "antialias": False,
    }
    pictures: dict[str, bytes] = {}
    for part in (_means(g), _scales(g), _quaternions(g), _colors(g), _bands(g)):
        meta |= part[0]
        pictures |= part[1]
    if metadata.known:
        meta["splatgraft"] = metadata.known
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {META_FILE: json.dumps(meta, separators=(",", ":")).encode(), **pictures}.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), data)
    return buffer.getvalue()


_Part = tuple[dict[str, Any], dict[str, bytes]]


def _means(g: Gaussians) -> _Part:
    means = g.means.double().numpy()
    logarithm = np.copysign(np.log1p(np.abs(means)), means)
    low, high = logarithm.min(0), logarithm.max(0)
    fixed = np.round((logarithm - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.int64)
    files = {
        "means_l.webp": _picture(_opaque((fixed & 255).astype(np.uint8))),
        "means_u.webp": _picture(_opaque((fixed >> 8).astype(np.uint8))),
    }
    return {"means": {"mins": low.tolist(), "maxs": high.tolist(), "files": list(files)}}, files


def _scales(g: Gaussians) -> _Part:
    values = g.log_scales.numpy()
    codes = scalar_codes(values.ravel())
    files = {"scales.webp": _picture(_opaque(nearest_codes(values, codes)))}
    return {"scales": {"codebook": codes.tolist(), "files": list(files)}}, files


def _quaternions(g: Gaussians) -> _Part:
    """The largest of w, x, y, z is left out and named by alpha."""
    largest, three = smallest_three(g.quaternions)
    tags = (largest + _FIRST_TAG).to(torch.uint8)[:, None]
    pixels = torch.cat([bytes_from_unit(three * _SQRT2 / 2 + 0.5), tags], 1).numpy()
    files = {"quats.webp": _picture(pixels)}
    return {"quats": {"files": list(files)}}, files


def _colors(g: Gaussians) -> _Part:
    values = g.sh[:, 0].numpy()
    codes = scalar_codes(values.ravel())
    pixels = np.concatenate([nearest_codes(values, codes), bytes_from_unit(g.opacities).numpy()[:, None]], 1)
    files = {"sh0.webp": _picture(pixels)}
    return {"sh0": {"codebook": codes.tolist(), "files": list(files)}}, files


def _bands(g: Gaussians) -> _Part:
    """Nothing for degree 0. A row of the palette's picture has 64 entries, each of k pixels."""
    if g.sh_degree == 0:
        return {}, {}
    k = g.sh.shape[1] - 1
    entries, labels = palette(g.sh[:, 1:].flatten(1), _palette_size(g.count))
    values = entries.reshape(-1, k, 3).numpy()
    codes = scalar_codes(values.ravel())
    rows = -(-len(values) // _PALETTE_COLUMNS)
    pixels = np.zeros((rows * _PALETTE_COLUMNS, k, 3), np.uint8)
    pixels[: len(values)] = nearest_codes(values, codes)
    low_high = np.stack([labels & 255, labels >> 8, np.zeros(len(labels))], 1).astype(np.uint8)
    files = {
        "shN_centroids.webp": _picture(_opaque(pixels.reshape(-1, 3)), width=_PALETTE_COLUMNS * k),
        "shN_labels.webp": _picture(_opaque(low_high)),
    }
    about = {"count": len(values), "bands": g.sh_degree, "codebook": codes.tolist(), "files": list(files)}
    return {"shN": about}, files


def _palette_size(count: int) -> int:
    return min(_LARGEST_PALETTE, max(_SMALLEST_PALETTE, count // _GAUSSIANS_PER_ENTRY))


def _opaque(rgb: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 4"]:
    return np.concatenate([rgb, np.full((len(rgb), 1), 255, np.uint8)], 1)


def _picture(pixels: UInt8[np.ndarray, "n 4"], *, width: int | None = None) -> bytes:
    """Pixels in rows as lossless WebP; about square, with sides of multiples of four, where no width is given."""
    width = width or 4 * math.ceil(math.sqrt(len(pixels)) / 4)
    height = -(-len(pixels) // width)
    full = np.zeros((height * width, 4), np.uint8)
    full[:, 3] = 255
    full[: len(pixels)] = pixels
    stream = io.BytesIO()
    Image.fromarray(full.reshape(height, width, 4)).save(stream, "WEBP", lossless=True, exact=True, quality=80)
    return stream.getvalue()
