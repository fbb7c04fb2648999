"""Reads SOG scenes (PlayCanvas, versions 1 and 2): a picture per field, with one pixel per Gaussian.

Version 2 looks scales and colours up in code books of 256 values, version 1 spreads bytes between bounds. Bands above 0
are rows of a palette that is a picture too. Positions are 16 bits of sign(x) log(1 + |x|). Axes are those of a .ply.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.json_file import array, excerpt
from splatgraft.formats.scenes.quantized import logits_from_bytes
from splatgraft.formats.scenes.scene_file import SceneFile
from splatgraft.formats.scenes.sog_container import open_sog, read_picture

_HALF_SQRT2 = 0.5**0.5
_PALETTE_COLUMNS = 64
"""Entries in a row of the palette."""
_CODES = 256
_LARGEST_TAG = 252
"""Alpha of a quaternion whose largest component is w; x, y, z follow."""

Bytes = UInt8[np.ndarray, "n c"]
Decode = Callable[[Bytes], Float[np.ndarray, "n c"]]


@dataclass(frozen=True)
class _Sog:
    """meta.json, its pictures, and the number of Gaussians."""

    path: Path
    meta: dict[str, Any]
    load: Callable[[str], bytes]
    count: int
    version: int

    def part(self, key: str) -> dict[str, Any]:
        """A table of meta.json."""
        part = self.meta.get(key)
        if not isinstance(part, dict):
            raise ValueError(f"{self.path}: expected a table '{key}' in meta.json, found {excerpt(part)}")
        return part

    def picture(self, key: str, index: int = 0) -> np.ndarray:
        """A picture that a table names, (h, w, 4)."""
        files = self.part(key).get("files")
        if not isinstance(files, list) or len(files) <= index or not isinstance(files[index], str):
            raise ValueError(f"{self.path}: expected {index + 1} or more files of '{key}', found {excerpt(files)}")
        return read_picture(self.path, files[index], self.load(files[index]))

    def bytes(self, key: str, index: int = 0) -> Bytes:
        """The pixels of the Gaussians, in order."""
        pixels = self.picture(key, index).reshape(-1, 4)
        if len(pixels) < self.count:
            raise ValueError(
                f"{self.path}: expected a pixel for each of {self.count} Gaussians in the picture of '{key}', "
                f"found {len(pixels)}"
            )
        return pixels[: self.count]

    def numbers(self, key: str, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Finite numbers of a table."""
        numbers = array(self.path, self.part(key), name, (shape,)).astype(np.float32)
        if not np.isfinite(numbers).all():
            raise ValueError(f"{self.path}: expected finite numbers for '{name}' of '{key}', found others")
        return numbers

    def decoder(self, key: str, channels: int) -> Decode:
        """From bytes to values: a code book (version 2), or between bounds per channel, or for all (version 1)."""
        if self.version == 2:
            codes = self.numbers(key, "codebook", (_CODES,))
            return lambda pixels: codes[pixels]
        shape = () if key == "shN" else (channels,)
        low, high = self.numbers(key, "mins", shape), self.numbers(key, "maxs", shape)
        return lambda pixels: low + (high - low) * (pixels.astype(np.float32) / 255)


def read_sog(path: Path) -> SceneFile:
    """The scene in a .sog, or in a folder with meta.json and pictures, or of that meta.json.

    Raises: ValueError where a file is missing or damaged, or they do not fit each other.
    """
    meta, load = open_sog(path)
    version = meta.get("version", 1)
    if version not in (1, 2) or isinstance(version, bool):
        raise ValueError(f"{path}: expected SOG version 1 or 2, found {excerpt(version)}")
    sog = _Sog(path, meta, load, _count(path, meta, version), version)
    colors = sog.bytes("sh0")
    if version == 2:
        dc, logits = sog.decoder("sh0", 3)(colors[:, :3]), logits_from_bytes(torch.from_numpy(colors[:, 3].copy()))
    else:
        values = sog.decoder("sh0", 4)(colors)
        dc, logits = values[:, :3], torch.from_numpy(values[:, 3].copy())
    sh = np.concatenate([dc[:, None], _bands(sog)], 1) if "shN" in meta else dc[:, None]
    gaussians = Gaussians(
        means=torch.from_numpy(_means(sog)),
        log_scales=torch.from_numpy(np.ascontiguousarray(sog.decoder("scales", 3)(sog.bytes("scales")[:, :3]))),
        quaternions=torch.from_numpy(_quaternions(sog.bytes("quats"))),
        opacity_logits=logits,
        sh=torch.from_numpy(np.ascontiguousarray(sh)),
    )
    up, metres = _own_metadata(meta)
    return SceneFile(gaussians, up=up, metres_per_unit=metres)


def _own_metadata(meta: dict[str, Any]) -> tuple[tuple[float, float, float] | None, float | None]:
    """Up and metres per unit where our own writer stated them; other content is not ours."""
    own = meta.get("splatgraft")
    up, metres = (own.get("up"), own.get("metres_per_unit")) if isinstance(own, dict) else (None, None)
    if isinstance(up, list) and len(up) == 3 and all(isinstance(value, int | float) for value in up):
        length = math.hypot(*up)
        up = (up[0] / length, up[1] / length, up[2] / length) if 0 < length < math.inf else None
    else:
        up = None
    if not isinstance(metres, int | float) or isinstance(metres, bool) or not 0 < metres < math.inf:
        return up, None
    return up, float(metres)


def _count(path: Path, meta: dict[str, Any], version: int) -> int:
    means = meta.get("means")
    shape = means.get("shape") if isinstance(means, dict) else None
    count = meta.get("count") if version == 2 else (shape[0] if isinstance(shape, list) and shape else None)
    if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count < 1 << 28:
        raise ValueError(f"{path}: expected the number of Gaussians in meta.json, found {excerpt(count)}")
    return count


def _means(sog: _Sog) -> Float[np.ndarray, "n 3"]:
    low, high = sog.numbers("means", "mins", (3,)), sog.numbers("means", "maxs", (3,))
    if max(np.abs(low).max(), np.abs(high).max()) > 60:
        raise ValueError(f"{sog.path}: expected logarithms of positions up to 60, found larger bounds")
    fixed = sog.bytes("means", 0)[:, :3].astype(np.float32) + 256 * sog.bytes("means", 1)[:, :3].astype(np.float32)
    logarithm = low + (high - low) * (fixed / 65535)
    return np.copysign(np.expm1(np.abs(logarithm)), logarithm)


def _quaternions(pixels: Bytes) -> Float[np.ndarray, "n 4"]:
    """Three components besides the largest, in order w, x, y, z; other tags stand for no rotation."""
    three = (pixels[:, :3].astype(np.float32) / 255 * 2 - 1) * np.float32(_HALF_SQRT2)
    largest = pixels[:, 3:].astype(np.int64) - _LARGEST_TAG
    known = (largest >= 0) & (largest < 4)
    three, largest = np.where(known, three, 0), np.where(known, largest, 0)
    axes = np.arange(3) + (np.arange(3) >= largest)
    out = np.zeros((len(pixels), 4), np.float32)
    np.put_along_axis(out, axes, three, 1)
    np.put_along_axis(out, largest, np.sqrt(np.maximum(0, 1 - np.square(three).sum(1, keepdims=True))), 1)
    return out


def _bands(sog: _Sog) -> Float[np.ndarray, "n k 3"]:
    """Bands above 0: the palette's entry that each Gaussian names."""
    labels = sog.bytes("shN", 1).astype(np.int64)
    labels = labels[:, 0] + 256 * labels[:, 1]
    palette = sog.picture("shN", 0)[:, :, :3]
    height, width = palette.shape[:2]
    degrees = {
        _PALETTE_COLUMNS * (spherical_harmonics.coefficient_count(d) - 1): d
        for d in range(1, spherical_harmonics.MAX_DEGREE + 1)
    }
    if width not in degrees or height > 65536 // _PALETTE_COLUMNS:
        raise ValueError(f"{sog.path}: expected a palette 192, 512 or 960 pixels wide, found {width} x {height}")
    k = width // _PALETTE_COLUMNS
    entries = palette.reshape(height * _PALETTE_COLUMNS, k, 3)
    if len(labels) and labels.max() >= len(entries):
        raise ValueError(f"{sog.path}: expected labels below {len(entries)}, found {labels.max()}")
    return sog.decoder("shN", 3)(entries.reshape(-1, 3)).reshape(-1, k, 3)[labels]
