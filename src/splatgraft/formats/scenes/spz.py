""".spz scenes (Niantic; reads versions 2 to 4, writes 3 and 4): quantised arrays, one per field.

Layout of Niantic's load-spz.cc: a header, then the arrays; in one gzip stream (versions 2 and 3), or plain with a table
of sizes and one zstd stream per array (version 4). Axes are right-up-back, ours and a .ply's are right-down-front.
"""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.axes import change_axes, rdf_from
from splatgraft.formats.scenes.quantization import (
    HALF_SQRT2,
    bytes_from_unit,
    from_smallest_three,
    logits_from_bytes,
    smallest_three,
    writable,
)
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata
from splatgraft.runtime.files import atomic_write

AXES = "RUB"
"""Axes of the file: right, up, back."""
_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
"""Magic number, version, Gaussians, SH degree, fractional bits of positions, flags, streams (version 4)."""
_TABLE_START = struct.Struct("<I12x")
_TABLE_ENTRY = struct.Struct("<QQ")
_GZIP = 31  # window bits of zlib for a gzip stream
_MAX_EXPANSION = 100
"""Largest ratio of the arrays' bytes to compressed ones: trained scenes have about 2, repeated Gaussians 50."""
_FREE_BYTES = 1 << 20  # arrays below this size may expand further
_COLOR_SCALE = 0.15


def read_spz(path: Path) -> SceneFile:
    """Read a .spz file."""
    data = path.read_bytes()
    packed = data[:4] == struct.pack("<I", _MAGIC)
    inflate = zlib.decompressobj(_GZIP)
    head = data[: _HEADER.size] if packed else inflate.decompress(data, _HEADER.size)
    magic, version, n, degree, bits, flags, streams = _HEADER.unpack(head)
    if magic != _MAGIC or version not in ((4,) if packed else (2, 3)) or degree > 3 or bits > 24:
        raise ValueError(
            "expected a .spz of version 2 to 4 with SH degree up to 3, "
            f"found magic {magic:#x}, version {version}, degree {degree}, {bits} bits"
        )
    widths = (9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1))
    sizes = [n * width for width in widths]
    if sum(sizes) > max(_FREE_BYTES, _MAX_EXPANSION * len(data)):
        raise ValueError(f"expected {n} Gaussians as the header says, found only {len(data)} compressed bytes")
    if packed:
        arrays = _zstd_arrays(path, data, streams, sizes)
    else:
        body = inflate.decompress(inflate.unconsumed_tail, sum(sizes) + _FREE_BYTES)  # extensions may follow the arrays
        arrays = [body[end - size : end] for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        if not inflate.eof:  # zlib has not compared its checksum
            raise ValueError(f"expected {n} Gaussians in one gzip stream, found a cut one, or more")
    fields = [np.frombuffer(array, np.uint8).reshape(n, width) for array, width in zip(arrays, widths, strict=True)]
    positions, alphas, colors, scales, rotations, bands = (torch.from_numpy(field.copy()) for field in fields)
    bands = (bands.reshape(n, widths[5] // 3, 3).float() - 128) / 128
    gaussians = Gaussians(
        means=_means(positions, bits),
        log_scales=scales.float() / 16 - 10,
        quaternions=_four_bytes_unpacked(rotations) if version >= 3 else _three_bytes_unpacked(rotations),
        opacity_logits=logits_from_bytes(alphas[:, 0]),
        sh=torch.cat([((colors.float() / 255 - 0.5) / _COLOR_SCALE)[:, None], bands], 1),
    )
    filtered = 'trained with an anti-aliasing filter: set low_pass = "antialiased" in [render] and [consolidate]'
    return SceneFile(change_axes(gaussians, rdf_from(AXES)), AXES, notes=(filtered,) if flags & 1 else ())


def _zstd_arrays(path: Path, data: bytes, streams: int, sizes: list[int]) -> list[bytes]:
    """Decompress version 4: a table of sizes, then one zstd stream per array that is not empty."""
    zstandard = _zstandard(path)
    (table,) = _TABLE_START.unpack_from(data, _HEADER.size)
    start, arrays = table + streams * _TABLE_ENTRY.size, []
    for size in sizes:
        if not size:
            arrays.append(b"")
            continue
        length, _ = _TABLE_ENTRY.unpack_from(data, table)
        stream = data[start : start + length]
        if zstandard.frame_content_size(stream) not in (size, -1):
            raise ValueError(f"expected a zstd stream of {size} bytes, found another size in its header")
        arrays.append(zstandard.ZstdDecompressor(max_window_size=1 << 27).decompress(stream, max_output_size=size))
        table, start = table + _TABLE_ENTRY.size, start + length
    if start != len(data):
        raise ValueError(f"expected the end of the file after its streams, found {len(data) - start} bytes")
    return arrays


def _zstandard(path: Path) -> Any:
    try:
        import zstandard
    except ImportError:
        raise ValueError(
            f"{path}: expected the package zstandard for .spz version 4, found none; "
            f"install it with: pip install 'splatgraft[spz]'"
        ) from None
    return zstandard


def _means(positions: UInt8[Tensor, "n 9"], fractional_bits: int) -> Float[Tensor, "n 3"]:
    """Decode 24-bit signed fixed point."""
    low, middle, high = positions.reshape(-1, 3, 3).int().unbind(-1)
    fixed = low | middle << 8 | high << 16
    return torch.where(fixed >= 1 << 23, fixed - (1 << 24), fixed).float() / (1 << fractional_bits)


def _three_bytes_unpacked(rotations: UInt8[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Decode x, y, z of a unit quaternion with w >= 0."""
    xyz = rotations.float() / 127.5 - 1
    return torch.cat([(1 - xyz.square().sum(1, keepdim=True)).clamp_min(0).sqrt(), xyz], 1)


def _four_bytes_unpacked(rotations: UInt8[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Decode the index of the largest of x, y, z, w in two bits, then the others in order: sign and 9 bits each."""
    packed = torch.from_numpy(rotations.numpy().view("<u4")[:, 0].astype(np.int64))
    three = packed[:, None] >> torch.tensor([20, 10, 0]) & 0x3FF
    values = (three & 0x1FF).float() / 0x1FF * HALF_SQRT2 * torch.where(three >> 9 == 1, -1.0, 1.0)
    return from_smallest_three(packed >> 30, values)[:, [3, 0, 1, 2]]


def write_spz(path: Path, gaussians: Gaussians, _: SceneMetadata = SceneMetadata(), *, version: int = 4) -> None:
    """Write positions in 24 bits of the extent, the rest in 8 bits, as zstd streams (4) or one gzip stream (3)."""
    if version not in (3, 4):
        raise ValueError(f"{path}: expected .spz version 3 or 4 to write, found {version}")
    g = change_axes(writable(path, gaussians, least=0), rdf_from(AXES))
    extent = float(g.means.abs().max()) if g.count else 1.0
    bits = max(b for b in range(-64, 24) if b < -60 or extent * 2.0**b <= 0x7FFFFF)
    if bits < 0:
        raise ValueError(f"{path}: expected positions within 8388607 units for a .spz file, found {extent:.4g}")
    fixed = (g.means.double() * 2.0**bits).round().to(torch.int64).numpy()
    arrays = [
        field.tobytes()
        for field in (
            np.stack([fixed & 0xFF, fixed >> 8 & 0xFF, fixed >> 16 & 0xFF], -1).astype(np.uint8),
            bytes_from_unit(g.opacities).numpy(),
            bytes_from_unit(g.sh[:, 0] * _COLOR_SCALE + 0.5).numpy(),
            ((g.log_scales + 10) * 16).round().clamp(0, 255).to(torch.uint8).numpy(),
            _four_bytes(g.quaternions),
            (g.sh[:, 1:] * 128 + 128).round().clamp(0, 255).to(torch.uint8).numpy(),
        )
    ]
    head = (_MAGIC, version, g.count, g.sh_degree, bits, 0)
    if version == 4:
        compressor = _zstandard(path).ZstdCompressor(level=12, write_content_size=True)  # as in load-spz.cc
        streams = [(compressor.compress(array), len(array)) for array in arrays if array]
        table_start = _HEADER.size + _TABLE_START.size
        table = b"".join(_TABLE_ENTRY.pack(len(stream), size) for stream, size in streams)
        parts = [_HEADER.pack(*head, len(streams)), _TABLE_START.pack(table_start), table, *(s for s, _ in streams)]
    else:
        deflate = zlib.compressobj(9, zlib.DEFLATED, _GZIP)
        parts = [deflate.compress(part) for part in (_HEADER.pack(*head, 0), *arrays)] + [deflate.flush()]
    with atomic_write(path) as stream:
        stream.write(b"".join(parts))


def _four_bytes(quaternions: Float[Tensor, "n 4"]) -> np.ndarray:
    largest, three = smallest_three(quaternions[:, [1, 2, 3, 0]])
    magnitude = (three.abs() / HALF_SQRT2 * 0x1FF).round().clamp(0, 0x1FF).to(torch.int64)
    fields = magnitude | (three < 0).to(torch.int64) << 9
    return (largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).numpy().astype("<u4")
