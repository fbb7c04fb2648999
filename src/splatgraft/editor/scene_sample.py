"""A sample of a trained scene as points, read with numpy alone.

torch takes seconds to load, and a scene of a million Gaussians to be read; evenly spaced rows of its .ply take a
fraction of a second.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

_COUNT = 60_000
"""Gaussians that are read; a browser receives and draws them in a fraction of a second."""
_POINT_SIZE = 0.6
"""Size of a point over the width of the median Gaussian, where all are read; of fewer, points are larger."""
_C0 = 0.28209479177387814
"""The constant of band 0 of the spherical harmonics, as in `core.spherical_harmonics`, which needs torch."""
_MAX_HEADER_BYTES = 1 << 14
_HEADER = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\n(?:comment [^\n]*\n)*"
    rb"element vertex ([0-9]{1,12})\n((?:property float \w+\n)+)end_header\n"
)
_FIELDS = ("x", "y", "z", "scale_0", "scale_1", "scale_2", "opacity", "f_dc_0", "f_dc_1", "f_dc_2")


@dataclass(frozen=True)
class SceneSample:
    """Some Gaussians of a scene that are more opaque than not, as points."""

    points: Float[np.ndarray, "m 3"]
    """Centres, world units."""
    colors: Float[np.ndarray, "m 3"]
    """sRGB in [0, 1]."""
    rows: Int[np.ndarray, "m"]
    """Row of each in the file."""
    point_size: float
    """Side of a drawn point, world units."""
    total: int
    """Gaussians in the file."""

    def without(self, erased: Bool[np.ndarray, "n"]) -> "SceneSample":
        """The sample without the erased Gaussians of the file; the same one where the flags belong to another file."""
        if len(erased) != self.total:
            return self
        kept = ~erased[self.rows]
        return replace(self, points=self.points[kept], colors=self.colors[kept], rows=self.rows[kept])


def read_sample(path: Path, *, most: int = _COUNT) -> SceneSample | None:
    """At most `most` evenly spaced Gaussians of a .ply as this program writes it; None for any other or broken file."""
    try:
        with path.open("rb") as stream:
            found = _HEADER.match(stream.read(_MAX_HEADER_BYTES))
    except OSError:
        return None
    if found is None:
        return None
    count, names = int(found[1]), [line.rpartition(b" ")[2].decode() for line in found[2].splitlines()]
    dtype = np.dtype([(name, "<f4") for name in names])
    if not set(_FIELDS) <= set(names) or count == 0 or path.stat().st_size < found.end() + count * dtype.itemsize:
        return None
    rows = np.arange(min(most, count)) * count // min(most, count)
    # the whole file is not read: the pages of these rows are
    read = np.memmap(path, dtype, mode="r", offset=found.end(), shape=(count,))[rows]
    columns = np.stack([read[name] for name in _FIELDS], axis=1)
    is_solid = np.isfinite(columns).all(axis=1) & (columns[:, 6] > 0)
    columns, rows = columns[is_solid], rows[is_solid]
    if not len(rows):
        return None
    width = float(np.exp(np.median(np.median(columns[:, 3:6], axis=1))))
    colors = (0.5 + np.float32(_C0) * columns[:, 7:10]).clip(0, 1)
    return SceneSample(columns[:, :3], colors, rows, _POINT_SIZE * width * max(1.0, (count / most) ** 0.5), count)
