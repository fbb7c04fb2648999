"""The containers of .spz: one gzip stream (versions 1 to 3), or a table of zstd streams (version 4).

Layout (Niantic, load-spz.cc): a header, then one array per field. Sizes that a header claims are compared with the
compressed size before anything is allocated.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_MAGIC = 0x5053474E
_GZIP_HEADER = struct.Struct("<IIIBBBB")
_ZSTD_HEADER = struct.Struct("<IIIBBBBI12x")
_TABLE_ENTRY = struct.Struct("<QQ")
_EXTENSION = struct.Struct("<II")
_COORDINATE_SYSTEM = 0xADBE0003
_GZIP = 31
_ZSTD_LEVEL = 12
"""As the format's own library."""
_LARGEST_DEGREE = 4
_ANTIALIASED, _EXTENDED = 1, 2
_MOST_EXPANSION = 100
"""Bytes of the arrays over compressed ones; files of trained scenes have about 2, a few repeated Gaussians 50."""
_FREE_BYTES = 1 << 20
"""Arrays below this size may expand further."""
_LARGEST_EXTENSION_BYTES = 1 << 20
_SYSTEMS = (
    "", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
    "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
)  # fmt: skip


@dataclass(frozen=True)
class PackedScene:
    """The arrays of a .spz file, still quantised."""

    version: int
    """1 to 4."""
    degree: int
    """Of the spherical harmonics, 0 to 4."""
    fractional_bits: int
    """Of positions in fixed point, 0 to 24; versions from 2 on."""
    antialiased: bool
    """Whether the scene was trained with an anti-aliasing filter."""
    axes: str
    """Directions of x, y and z, such as RUB."""
    fields: tuple[np.ndarray, ...]
    """Positions, alphas, colours, scales, rotations and SH bands; bytes, (n, width)."""


def unpack(path: Path, data: bytes) -> PackedScene:
    """The arrays in the bytes of a .spz.

    Raises: ValueError where the bytes are cut, damaged, of another version, or expand beyond measure.
    """
    if data[:4] == struct.pack("<I", _MAGIC):
        return _from_zstd(path, data)
    inflate = zlib.decompressobj(_GZIP)
    head = _inflated(path, inflate, data, _GZIP_HEADER.size)
    magic, version, n, degree, bits, flags, _ = _GZIP_HEADER.unpack(head)
    _require_known(path, magic, version, degree, bits)
    if version > 3:
        raise ValueError(f"{path}: expected version 1 to 3 in a gzip stream, found {version}")
    widths = _widths(version, degree)
    _require_size(path, n, n * sum(widths), len(data))
    body = _inflated(path, inflate, inflate.unconsumed_tail, n * sum(widths))
    rest = _step(path, inflate, inflate.unconsumed_tail, _LARGEST_EXTENSION_BYTES if flags & _EXTENDED else 1)
    if not inflate.eof or inflate.unused_data or (rest and not flags & _EXTENDED):
        raise ValueError(f"{path}: expected the end of the gzip stream after {n} Gaussians, found more or a cut end")
    ends = np.cumsum([n * width for width in widths])
    fields = np.split(np.frombuffer(body, np.uint8), ends[:-1])
    return _packed(path, (version, degree, bits, flags), rest, _rows(n, fields, widths))


def pack(path: Path, scene: PackedScene) -> bytes:
    """The bytes of a .spz of the scene's version, 2 to 4, without extensions.

    Raises: ValueError where version 4 needs a package that is not installed.
    """
    flags = _ANTIALIASED if scene.antialiased else 0
    head = (_MAGIC, scene.version, len(scene.fields[0]), scene.degree, scene.fractional_bits, flags)
    arrays = [field.tobytes() for field in scene.fields]
    if scene.version < 4:
        deflate = zlib.compressobj(9, zlib.DEFLATED, _GZIP)
        parts = [deflate.compress(part) for part in (_GZIP_HEADER.pack(*head, 0), *arrays)]
        return b"".join([*parts, deflate.flush()])
    compressor = _zstandard(path).ZstdCompressor(level=_ZSTD_LEVEL, write_content_size=True)
    streams = [(compressor.compress(array), len(array)) for array in arrays if array]
    table = b"".join(_TABLE_ENTRY.pack(len(data), size) for data, size in streams)
    header = _ZSTD_HEADER.pack(*head, len(streams), _ZSTD_HEADER.size)
    return b"".join([header, table, *(data for data, _ in streams)])


def _zstandard(path: Path) -> Any:
    try:
        import zstandard
    except ImportError:
        raise ValueError(
            f"{path}: expected the package zstandard for .spz version 4, found none; "
            f"install it with: pip install 'splatgraft[spz]'"
        ) from None
    return zstandard


def _from_zstd(path: Path, data: bytes) -> PackedScene:
    """Version 4: plain header and extensions, table of sizes, one zstd stream per array that is not empty."""
    if len(data) < _ZSTD_HEADER.size:
        raise ValueError(f"{path}: expected a .spz header of {_ZSTD_HEADER.size} bytes, found {len(data)}")
    magic, version, n, degree, bits, flags, streams, table = _ZSTD_HEADER.unpack_from(data)
    _require_known(path, magic, version, degree, bits)
    if version != 4:
        raise ValueError(f"{path}: expected version 4 before zstd streams, found {version}")
    widths = _widths(version, degree)
    _require_size(path, n, n * sum(widths), len(data))
    sizes = [n * width for width in widths]
    start = table + streams * _TABLE_ENTRY.size
    if streams != sum(size > 0 for size in sizes) or table < _ZSTD_HEADER.size or start > len(data):
        raise ValueError(f"{path}: expected a table of the streams within {len(data)} bytes, found another")
    entries = iter(range(table, start, _TABLE_ENTRY.size))
    fields = []
    for size in sizes:
        if not size:
            fields.append(np.empty(0, np.uint8))
            continue
        packed, unpacked = _TABLE_ENTRY.unpack_from(data, next(entries))
        if unpacked != size or packed > len(data) - start:
            raise ValueError(f"{path}: expected a stream of {size} bytes, found {unpacked} in {packed} compressed ones")
        fields.append(np.frombuffer(_decompressed(path, data[start : start + packed], size), np.uint8))
        start += packed
    if start != len(data):
        raise ValueError(f"{path}: expected the end of the file after its streams, found {len(data) - start} bytes")
    extensions = data[_ZSTD_HEADER.size : table] if flags & _EXTENDED else b""
    return _packed(path, (version, degree, bits, flags), extensions, _rows(n, fields, widths))


def _decompressed(path: Path, data: bytes, size: int) -> bytes:
    zstandard = _zstandard(path)
    try:
        if zstandard.frame_content_size(data) not in (size, -1):
            raise ValueError(f"{path}: expected a zstd stream of {size} bytes, found another size in its header")
        out = zstandard.ZstdDecompressor(max_window_size=1 << 27).decompress(data, max_output_size=size)
    except zstandard.ZstdError as error:
        raise ValueError(f"{path}: expected a whole zstd stream, found {str(error)[:80]}") from None
    if len(out) != size:
        raise ValueError(f"{path}: expected {size} bytes in a zstd stream, found {len(out)}")
    return out


def _require_known(path: Path, magic: int, version: int, degree: int, bits: int) -> None:
    if magic != _MAGIC or version not in (1, 2, 3, 4) or degree > _LARGEST_DEGREE or bits > 24:
        raise ValueError(
            f"{path}: expected a .spz of version 1 to 4, SH degree up to {_LARGEST_DEGREE}, up to 24 fractional bits, "
            f"found magic {magic:#x}, version {version}, degree {degree}, {bits} bits"
        )


def _widths(version: int, degree: int) -> tuple[int, ...]:
    """Bytes per Gaussian of each array."""
    return (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1))


def _require_size(path: Path, n: int, size: int, available: int) -> None:
    if size > max(_FREE_BYTES, _MOST_EXPANSION * available):
        raise ValueError(f"{path}: expected {n} Gaussians as the header says, found only {available} compressed bytes")


def _rows(n: int, fields: list[np.ndarray], widths: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    return tuple(field.reshape(n, width) for field, width in zip(fields, widths, strict=True))


def _packed(
    path: Path, header: tuple[int, int, int, int], extensions: bytes, fields: tuple[np.ndarray, ...]
) -> PackedScene:
    version, degree, bits, flags = header
    return PackedScene(
        version=version,
        degree=degree,
        fractional_bits=bits,
        antialiased=bool(flags & _ANTIALIASED),
        axes=_axes(path, extensions),
        fields=fields,
    )


def _axes(path: Path, extensions: bytes) -> str:
    """The coordinate system that an extension states; RUB without one. Records: type, length, payload."""
    at = 0
    while at + _EXTENSION.size <= len(extensions):
        kind, length = _EXTENSION.unpack_from(extensions, at)
        at += _EXTENSION.size
        if length > len(extensions) - at:
            break
        if kind == _COORDINATE_SYSTEM:
            number = int.from_bytes(extensions[at : at + length][:4], "little")
            if length < 4 or number >= len(_SYSTEMS):
                raise ValueError(f"{path}: expected a coordinate system from 0 to 16 in the extension, found {number}")
            return _SYSTEMS[number] or "RUB"
        at += length
    return "RUB"


def _inflated(path: Path, inflate: Any, data: bytes, size: int) -> bytes:
    out = _step(path, inflate, data, size) if size else b""
    if len(out) < size:
        raise ValueError(f"{path}: expected {size} bytes in the gzip stream, found {len(out)}")
    return out


def _step(path: Path, inflate: Any, data: bytes, limit: int) -> bytes:
    try:
        return inflate.decompress(data, limit)
    except zlib.error as error:
        raise ValueError(f"{path}: expected a whole gzip stream, found {error}") from None
