"""SOG scenes (PlayCanvas, version 2): lossless images with one pixel per Gaussian, and meta.json, in a zip or a folder.

- Positions are 16 bits of sign(x) log(1 + |x|).
- Scales and colours index code books of 256 values, found by k-means (Lloyd 1982).
- Bands above 0 index the rows of a palette, an image too. For speed, k-means finds it in two levels: rows are divided
  among coarse groups, then each group gets its share of the entries.
- Axes are those of a .ply. The writer sorts Gaussians along a Morton curve, so that neighbours compress well.
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from PIL import Image
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.k_means import k_means
from splatgraft.formats.scenes.quantization import (
    bytes_from_unit,
    logits_from_bytes,
    morton_order,
    smallest_three,
    writable,
)
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata, stated_metadata
from splatgraft.runtime.files import atomic_write

_META_FILE = "meta.json"
_OWN_KEY = "splatgraft"  # of the metadata in meta.json
_FIRST_TAG = 252  # alpha of a quaternion whose largest component is w; 253 to 255 are x, y, z
_PALETTE_COLUMNS = 64  # entries in a row of the palette's image
_MIN_PALETTE, _MAX_PALETTE = 1 << 10, 1 << 16
_GAUSSIANS_PER_ENTRY = 4  # of the palette; chosen by size and PSNR of the demo's scenes
_MAX_PIXELS_PER_BYTE = 100
"""Bound for images above `_FREE_PIXELS`: random bytes have 0.3, a scene of few different Gaussians 50."""
_FREE_PIXELS = 1 << 20
_MAX_META_BYTES = 1 << 24  # of meta.json, which has about 20 kB
_MAX_EXPANSION = 10  # bytes of a file over those in the zip; images are compressed already
_FREE_BYTES = 1 << 20  # files below this size may expand further
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others are unpacked whole, beyond the size that the zip states
_MAX_LOG_POSITION = 60.0  # beyond, float32 overflows soon
_CODES = 256
_COARSE_GROUPS = 256
_ROUNDS = 5  # iterations of k-means for groups and entries; more changed the demo's renders by less than 0.1 dB


def is_sog_folder(path: Path) -> bool:
    """Whether `path` is a folder of SOG images, or its meta.json."""
    meta = path / _META_FILE if path.is_dir() else path
    if meta.name.lower() != _META_FILE or not meta.is_file():
        return False
    try:
        content = json.loads(meta.read_bytes())
    except (ValueError, RecursionError, OSError):
        return False
    return isinstance(content, dict) and {"means", "scales", "quats"} <= set(content)


def sog_files(path: Path) -> tuple[Path, ...]:
    """List all files of a folder with meta.json; `path` is the folder or that file."""
    folder = path if path.is_dir() else path.parent
    return tuple(sorted(entry for entry in folder.iterdir() if entry.suffix.lower() in (".json", ".webp", ".png")))


def read_sog(path: Path) -> SceneFile:
    """Read a .sog, or a folder with meta.json and images; `path` may be that meta.json."""
    meta = json.loads(_load(path, _META_FILE))
    n = meta["count"]
    if meta["version"] != 2 or not 0 <= n < 1 << 28:
        raise ValueError(f"expected SOG version 2, found version {meta['version']} of {n} Gaussians")

    def picture(key: str, index: int = 0) -> UInt8[np.ndarray, "h w 4"]:
        name = meta[key]["files"][index]
        return _read_picture(name, _load(path, name))

    def pixels(key: str, index: int = 0) -> UInt8[np.ndarray, "n 4"]:
        found = picture(key, index).reshape(-1, 4)
        if len(found) < n:
            raise ValueError(f"expected pixels of {n} Gaussians in an image of '{key}', found {len(found)}")
        return found[:n]

    def codes(key: str) -> Float[np.ndarray, "256"]:
        return _finite(meta[key]["codebook"], (_CODES,))

    low, high = (_finite(meta["means"][end], (3,)) for end in ("mins", "maxs"))
    if max(np.abs(low).max(), np.abs(high).max()) > _MAX_LOG_POSITION:
        raise ValueError(f"expected logarithms of positions up to {_MAX_LOG_POSITION:g}, found larger bounds")
    fixed = pixels("means", 0)[:, :3].astype(np.float32) + 256 * pixels("means", 1)[:, :3].astype(np.float32)
    logarithm = low + (high - low) * (fixed / 65535)
    colors = pixels("sh0")
    sh = codes("sh0")[colors[:, :3]][:, None]
    if "shN" in meta:
        entries = picture("shN")[:, :, :3]
        k = entries.shape[1] // _PALETTE_COLUMNS
        labels = pixels("shN", 1).astype(np.int64)
        bands = codes("shN")[entries.reshape(-1, k, 3)]
        sh = np.concatenate([sh, bands[labels[:, 0] + 256 * labels[:, 1]]], 1)
    gaussians = Gaussians(
        means=torch.from_numpy(np.copysign(np.expm1(np.abs(logarithm)), logarithm)),
        log_scales=torch.from_numpy(np.ascontiguousarray(codes("scales")[pixels("scales")[:, :3]])),
        quaternions=torch.from_numpy(_quaternions(pixels("quats"))),
        opacity_logits=logits_from_bytes(torch.from_numpy(colors[:, 3].copy())),
        sh=torch.from_numpy(np.ascontiguousarray(sh)),
    )
    own = meta.get(_OWN_KEY, {})
    return SceneFile(gaussians, metadata=stated_metadata(own.get("up"), own.get("metres_per_unit")))


def _load(path: Path, name: str) -> bytes:
    """Read a file of the scene."""
    if path.is_file() and path.name.lower() != _META_FILE:
        with zipfile.ZipFile(path) as archive, archive.open(name) as stream:
            entry = archive.getinfo(name)
            most = _MAX_META_BYTES if name == _META_FILE else _MAX_EXPANSION * entry.compress_size
            if entry.file_size > max(_FREE_BYTES, most) or entry.compress_type not in _METHODS:
                found = f"{entry.file_size} bytes in {entry.compress_size}, method {entry.compress_type}"
                raise ValueError(f"expected {name} of a scene, deflated or stored, found {found}")
            # read() without a size would unpack beyond the size that the zip states
            return stream.read(entry.file_size)
    if Path(name).name != name or "\\" in name:
        raise ValueError(f"expected plain file names in {_META_FILE}, found {name[:60]!r}")
    return ((path if path.is_dir() else path.parent) / name).read_bytes()


def _read_picture(name: str, data: bytes) -> UInt8[np.ndarray, "h w 4"]:
    with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
        if image.width * image.height > max(_FREE_PIXELS, _MAX_PIXELS_PER_BYTE * len(data)):
            found = f"{image.width} x {image.height} pixels in {len(data)} bytes"
            raise ValueError(f"expected {name} to be as large as its bytes, found {found}")
        return np.asarray(image.convert("RGBA"))


def _finite(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    numbers = np.array(values, np.float64).astype(np.float32)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"expected {shape[0]} finite numbers in {_META_FILE}, found others")
    return numbers


def _quaternions(pixels: UInt8[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Decode the three components besides the largest, in order w, x, y, z; other tags mean no rotation."""
    three = (pixels[:, :3].astype(np.float32) / 255 * 2 - 1) * np.float32(0.5**0.5)
    largest = pixels[:, 3:].astype(np.int64) - _FIRST_TAG
    three, largest = np.where(largest >= 0, three, 0), np.maximum(largest, 0)
    out = np.zeros((len(pixels), 4), np.float32)
    np.put_along_axis(out, np.arange(3) + (np.arange(3) >= largest), three, 1)
    np.put_along_axis(out, largest, np.sqrt(np.maximum(0, 1 - np.square(three).sum(1, keepdims=True))), 1)
    return out


def write_sog(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write positions as 16 bits of their logarithm, scales and colours by code books, bands by a palette."""
    with atomic_write(path) as stream:
        stream.write(encode_sog(path, gaussians, metadata))


def encode_sog(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> bytes:
    """Encode a .sog; `path` is for messages."""
    g = writable(path, gaussians)
    g = g.select(morton_order(g.means))
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "splatgraft"}, "count": g.count, "antialias": False}
    pictures: dict[str, bytes] = {}

    def add(key: str, files: dict[str, bytes], **about: Any) -> None:
        meta[key] = about | {"files": list(files)}
        pictures.update(files)

    means = g.means.double().numpy()
    logarithm = np.copysign(np.log1p(np.abs(means)), means)
    low, high = logarithm.min(0), logarithm.max(0)
    fixed = np.round((logarithm - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.int64)
    halves = {"means_l.webp": _picture(fixed & 255), "means_u.webp": _picture(fixed >> 8)}
    add("means", halves, mins=low.tolist(), maxs=high.tolist())

    scales = g.log_scales.numpy()
    codes = scalar_codes(scales.ravel())
    add("scales", {"scales.webp": _picture(nearest_codes(scales, codes))}, codebook=codes.tolist())

    largest, three = smallest_three(g.quaternions)
    three_bytes = bytes_from_unit(three * 2**0.5 / 2 + 0.5)
    add("quats", {"quats.webp": _picture(three_bytes.numpy(), (largest + _FIRST_TAG).numpy())})

    dc = g.sh[:, 0].numpy()
    codes = scalar_codes(dc.ravel())
    opacities = bytes_from_unit(g.opacities).numpy()
    add("sh0", {"sh0.webp": _picture(nearest_codes(dc, codes), opacities)}, codebook=codes.tolist())

    if g.sh_degree:
        k = g.sh.shape[1] - 1
        size = min(_MAX_PALETTE, max(_MIN_PALETTE, g.count // _GAUSSIANS_PER_ENTRY))
        entries, labels = palette(g.sh[:, 1:].flatten(1), size)
        values = entries.reshape(-1, k, 3).numpy()
        codes = scalar_codes(values.ravel())
        centroids = np.zeros((-(-len(values) // _PALETTE_COLUMNS) * _PALETTE_COLUMNS, k, 3), np.uint8)
        centroids[: len(values)] = nearest_codes(values, codes)
        files = {
            "shN_centroids.webp": _picture(centroids.reshape(-1, 3), width=_PALETTE_COLUMNS * k),
            "shN_labels.webp": _picture(np.stack([labels & 255, labels >> 8, np.zeros(len(labels))], 1)),
        }
        add("shN", files, count=len(values), bands=g.sh_degree, codebook=codes.tolist())
    if metadata.known:
        meta[_OWN_KEY] = metadata.known
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {_META_FILE: json.dumps(meta, separators=(",", ":")).encode(), **pictures}.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()


def _picture(rgb: np.ndarray, alpha: np.ndarray | int = 255, *, width: int | None = None) -> bytes:
    """Encode pixels (n 3) in rows as lossless WebP; without `width` about square, with sides of multiples of four."""
    width = width or 4 * math.ceil(math.sqrt(len(rgb)) / 4)
    height = -(-len(rgb) // width)
    full = np.zeros((height * width, 4), np.uint8)
    full[:, 3] = 255
    full[: len(rgb), :3], full[: len(rgb), 3] = rgb, alpha
    stream = io.BytesIO()
    Image.fromarray(full.reshape(height, width, 4)).save(stream, "WEBP", lossless=True, exact=True, quality=80)
    return stream.getvalue()


def scalar_codes(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "256"]:
    """Fit 256 ascending codes to `values` with a small squared error; of fewer distinct values the last is repeated."""
    ordered = np.sort(values.astype(np.float64))
    distinct = np.unique(ordered)
    if len(distinct) <= _CODES:
        return np.pad(distinct, (0, _CODES - len(distinct)), mode="edge").astype(np.float32)
    # half of the codes by quantiles, half evenly over the range, so that rare large values have codes from the start
    quantiles = np.quantile(ordered, (np.arange(_CODES // 2) + 0.5) / (_CODES // 2))
    codes = np.sort(np.concatenate([quantiles, np.linspace(ordered[0], ordered[-1], _CODES // 2)]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(100):
        ends = np.concatenate([[0], np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        codes = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
    return np.sort(codes).astype(np.float32)


def nearest_codes(values: Float[np.ndarray, "*shape"], codes: Float[np.ndarray, "256"]) -> UInt8[np.ndarray, "*shape"]:
    """Find the index of the nearest code, for ascending codes."""
    return np.searchsorted((codes[1:] + codes[:-1]) / 2, values).astype(np.uint8)


def palette(rows: Float[Tensor, "n f"], size: int) -> tuple[Float[Tensor, "p f"], Int64[Tensor, "n"]]:
    """Fit at most `size` rows that represent all; returns them and the index of each row's entry."""
    n = len(rows)
    if n <= size:
        return rows, torch.arange(n)
    sample = rows[_spread(n, min(n, 1 << 15))]
    coarse = k_means(sample, sample[_spread(len(sample), min(_COARSE_GROUPS, size))], rounds=_ROUNDS)
    group = _nearest(rows, coarse)
    members = [torch.nonzero(group == i)[:, 0] for i in range(int(group.max()) + 1)]
    entries, labels, start = [], torch.empty(n, dtype=torch.int64), 0
    for chosen in members:
        if not len(chosen):
            continue
        own = rows[chosen]
        # rounded down, but at least one; the sum is at most `size`, because there are at most `size` groups
        share = max(1, int(len(chosen) / n * (size - len(members))))
        means = k_means(own, own[_spread(len(own), share)], rounds=_ROUNDS)
        entries.append(means)
        labels[chosen] = start + _nearest(own, means)
        start += len(means)
    return torch.cat(entries), labels


def _spread(n: int, count: int) -> Int64[Tensor, "count"]:
    """Select `count` of n indices, evenly spaced."""
    return (torch.arange(count) * n) // count


def _nearest(rows: Float[Tensor, "n f"], means: Float[Tensor, "k f"]) -> Int64[Tensor, "n"]:
    return torch.cat([torch.cdist(part, means).argmin(1) for part in rows.split(1 << 14)])
