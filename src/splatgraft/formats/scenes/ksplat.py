"""Reads .ksplat scenes (mkkellogg/GaussianSplats3D, version 0.1, compression levels 0 to 2): sections of buckets.

A section has Gaussians of one layout: position, scale, quaternion wxyz, RGBA, SH bands 1 and 2. At levels 1 and 2
positions are 16-bit offsets from the middle of a bucket, SH bands 8 bits at level 2. Axes are those of a .ply.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.formats.scenes.quantized import logits_from_bytes
from splatgraft.formats.scenes.scene_file import SceneFile

_HEADER_BYTES, _SECTION_HEADER_BYTES = 4096, 1024
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
_SMALLEST_SCALE = 1e-30
"""World units; replaces a scale of exactly 0, since the logarithm is stored."""
_REST = (0, 9, 24)
"""Numbers of bands above 0, by degree."""


@dataclass(frozen=True)
class _Section:
    """The header of a section."""

    count: int
    room: int
    """Gaussians that its storage has room for."""
    bucket_capacity: int
    bucket_count: int
    block_size: float
    """Side of a bucket, world units."""
    bucket_bytes: int
    position_range: int
    """Integer that stands for half a bucket."""
    full_buckets: int
    partial_buckets: int
    degree: int


@dataclass(frozen=True)
class _File:
    path: Path
    data: bytes
    level: int
    rest_bounds: tuple[float, float]

    def row(self, degree: int) -> np.dtype:
        """Layout of a Gaussian."""
        real = "<f4" if self.level == 0 else "<f2"
        rest = ("<f4", "<f2", "u1")[self.level]
        position = "<f4" if self.level == 0 else "<u2"
        return np.dtype(
            [("position", position, 3), ("scale", real, 3), ("quaternion", real, 4), ("rgba", "u1", 4)]
            + ([("rest", rest, _REST[degree])] if degree else [])
        )


def read_ksplat(path: Path) -> SceneFile:
    """The scene in a .ksplat file.

    Raises: ValueError where the file is cut, of another version, or its sections do not fit it.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a .ksplat file, found none")
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES or data[0] != 0 or data[1] < 1:
        raise ValueError(f"{path}: expected a .ksplat of version 0.1, found {data[:2]!r} in {len(data)} bytes")
    sections, total = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<I", data, 16)[0]
    level = struct.unpack_from("<H", data, 20)[0]
    low, high = struct.unpack_from("<ff", data, 36)
    at = _HEADER_BYTES + sections * _SECTION_HEADER_BYTES
    if level > 2 or at > len(data):
        raise ValueError(f"{path}: expected compression level 0 to 2 and whole sections, found {level} and {sections}")
    file = _File(path, data, level, (low or -1.5, high or 1.5))
    parts: list[Gaussians] = []
    for i in range(sections):
        header = _SECTION.unpack_from(data, _HEADER_BYTES + i * _SECTION_HEADER_BYTES)
        section = _Section(*header)
        if section.degree >= len(_REST):
            raise ValueError(f"{path}: expected SH degree 0 to 2 in a section, found {section.degree}")
        part, at = _gaussians(file, section, at)
        parts.append(part)
    if sum(part.count for part in parts) != total or not parts:
        raise ValueError(f"{path}: expected {total} Gaussians, found {sum(part.count for part in parts)} in sections")
    return SceneFile(concatenate(parts))


def _gaussians(file: _File, section: _Section, start: int) -> tuple[Gaussians, int]:
    """The Gaussians of the section whose storage begins at `start`, and where the next begins."""
    row = file.row(section.degree)
    centers_at = start + 4 * section.partial_buckets
    rows_at = centers_at + section.bucket_bytes * section.bucket_count
    end = rows_at + row.itemsize * section.room
    if end > len(file.data) or section.count > section.room:
        raise ValueError(f"{file.path}: expected {section.count} Gaussians in a section, found {len(file.data)} bytes")
    rows = np.frombuffer(file.data, row, section.count, rows_at)
    positions, scales = rows["position"].astype(np.float32), rows["scale"].astype(np.float32)
    if file.level:
        if section.bucket_bytes < 12 and section.bucket_count:
            raise ValueError(f"{file.path}: expected 12 or more bytes per bucket, found {section.bucket_bytes}")
        half = section.position_range or 32767
        centers = np.ndarray(
            (section.bucket_count, 3), "<f4", file.data, centers_at, (section.bucket_bytes, 4)
        )  # buckets may be wider than their centre
        positions = (positions - half) * (section.block_size / 2 / half) + centers[_buckets(file, section, start)]
    if not (np.isfinite(positions).all() and np.isfinite(scales).all() and (scales >= 0).all()):
        raise ValueError(f"{file.path}: expected finite positions and scales of 0 or more, found others in a section")
    dc = spherical_harmonics.dc_from_rgb(torch.from_numpy(rows["rgba"][:, :3].astype(np.float32)) / 255)
    gaussians = Gaussians(
        means=torch.from_numpy(positions),
        log_scales=torch.from_numpy(scales).clamp_min(_SMALLEST_SCALE).log(),
        quaternions=torch.from_numpy(rows["quaternion"].astype(np.float32)),
        opacity_logits=logits_from_bytes(torch.from_numpy(rows["rgba"][:, 3].copy())),
        sh=torch.cat([dc[:, None], torch.from_numpy(_bands(file, rows, section.degree))], 1),
    )
    return gaussians, end


def _buckets(file: _File, section: _Section, start: int) -> Int64[np.ndarray, "n"]:
    """The bucket of each Gaussian: full ones first, then partial ones of given sizes."""
    sizes = np.frombuffer(file.data, "<u4", section.partial_buckets, start).astype(np.int64)
    counts = np.concatenate([np.full(min(section.full_buckets, section.count), section.bucket_capacity), sizes])
    ends = np.cumsum(counts.astype(np.float64))
    buckets = np.searchsorted(ends, np.arange(section.count), side="right")
    if section.count and (not len(ends) or buckets[-1] >= min(section.bucket_count, len(ends))):
        raise ValueError(f"{file.path}: expected a bucket for each Gaussian, found {section.bucket_count}")
    return buckets


def _bands(file: _File, rows: np.ndarray, degree: int) -> Float[np.ndarray, "n k 3"]:
    """Bands above 0; each stores its coefficients channel by channel."""
    if not degree:
        return np.empty((len(rows), 0, 3), np.float32)
    values = rows["rest"].astype(np.float32)
    if file.level == 2:
        low, high = file.rest_bounds
        values = low + values / 255 * (high - low)
    bands, at = [], 0
    for band in range(1, degree + 1):
        width = 2 * band + 1
        bands.append(values[:, at : at + 3 * width].reshape(len(rows), 3, width).transpose(0, 2, 1))
        at += 3 * width
    return np.ascontiguousarray(np.concatenate(bands, 1), dtype=np.float32)
