""".ksplat scenes (mkkellogg/GaussianSplats3D, version 0.1, compression levels 0 to 2): sections of buckets.

A section has one layout of Gaussians: position, scale, quaternion wxyz, RGBA, SH bands 1 and 2. At levels 1 and 2
positions are 16-bit offsets from the middle of a bucket; at level 2 SH bands have 8 bits. Axes are those of a .ply.
"""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.formats.scenes.quantization import from_linear
from splatgraft.formats.scenes.scene_file import SceneFile

_HEADER_BYTES, _SECTION_HEADER_BYTES = 4096, 1024
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
_REST = (0, 9, 24)  # numbers of coefficients above band 0, by degree


def read_ksplat(path: Path) -> SceneFile:
    """Read a .ksplat file."""
    data = path.read_bytes()
    sections, total = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<I", data, 16)[0]
    level = struct.unpack_from("<H", data, 20)[0]
    low, high = struct.unpack_from("<ff", data, 36)
    if data[0] != 0 or data[1] < 1 or level > 2:
        raise ValueError(f"expected a .ksplat of version 0.1, found {data[:2]!r} of level {level}")
    at = _HEADER_BYTES + sections * _SECTION_HEADER_BYTES
    parts: list[Gaussians] = []
    for i in range(sections):
        # a section has room for more than `count`; a bucket is `side` world units wide, encoded as twice `half`
        count, room, capacity, buckets, side, bucket_bytes, half, full, partial, degree = _SECTION.unpack_from(
            data, _HEADER_BYTES + i * _SECTION_HEADER_BYTES
        )
        row, centers_at = _row(level, degree), at + 4 * partial
        rows_at = centers_at + bucket_bytes * buckets
        rows = np.frombuffer(data, row, count, rows_at)
        positions = rows["position"].astype(np.float32)
        if level:
            half = half or 32767
            # full buckets come first, then partial ones of given sizes; they may be wider than their centre
            sizes = np.frombuffer(data, "<u4", partial, at).astype(np.int64)
            ends = np.cumsum(np.concatenate([np.full(min(full, count), capacity), sizes]))
            centers = np.ndarray((buckets, 3), "<f4", data, centers_at, (bucket_bytes, 4))
            own = centers[np.searchsorted(ends, np.arange(count), side="right")]
            positions = (positions - half) * (side / 2 / half) + own
        scales, quaternions = (torch.from_numpy(rows[name].astype(np.float32)) for name in ("scale", "quaternion"))
        rgba = torch.from_numpy(rows["rgba"].copy())
        part = from_linear(torch.from_numpy(positions), scales, quaternions, rgba)
        bands = torch.from_numpy(_bands(rows, degree, level, (low or -1.5, high or 1.5)))
        parts.append(replace(part, sh=torch.cat([part.sh, bands], 1)))
        at = rows_at + row.itemsize * room
    if sum(part.count for part in parts) != total:
        raise ValueError(f"expected {total} Gaussians, found {sum(part.count for part in parts)} in sections")
    return SceneFile(concatenate(parts))


def _row(level: int, degree: int) -> np.dtype:
    """Return the layout of a Gaussian."""
    real, position, rest = ("<f4", "<f4", "<f4") if level == 0 else ("<f2", "<u2", ("<f2", "u1")[level - 1])
    fields = [("position", position, 3), ("scale", real, 3), ("quaternion", real, 4), ("rgba", "u1", 4)]
    return np.dtype(fields + ([("rest", rest, _REST[degree])] if degree else []))


def _bands(rows: np.ndarray, degree: int, level: int, bounds: tuple[float, float]) -> Float[np.ndarray, "n k 3"]:
    """Decode bands above 0; each stores its coefficients channel by channel."""
    values = rows["rest"].astype(np.float32) if degree else np.empty((len(rows), 0), np.float32)
    if level == 2:
        values = bounds[0] + values / 255 * (bounds[1] - bounds[0])
    split = [values[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)] for d in range(1, degree + 1)]
    bands = [band.reshape(len(rows), 3, band.shape[1] // 3).transpose(0, 2, 1) for band in split]
    none = np.empty((len(rows), 0, 3), np.float32)
    return np.ascontiguousarray(np.concatenate([none, *bands], 1), dtype=np.float32)
