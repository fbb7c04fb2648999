"""A sample of a trained scene and the camera that first looks at it, read with numpy alone.

torch takes seconds to load, and a scene of a million Gaussians to be read; evenly spaced rows of its .ply take a
fraction of a second. They are enlarged so that they cover about what all of them do; large ones keep their size.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

SAMPLE_COUNT = 60_000
"""Gaussians; a browser receives and sorts them in a fraction of a second."""
_FILL = 1.2
"""Enlargement beyond equal areas, which closes gaps between Gaussians that lie at random. Of 1, 1.3 and 1.6, renders of
two trained scenes of 22,000 Gaussians by 1,300 were nearest to the whole scene's at 1 to 1.3 (15 to 22 dB)."""
_C0 = 0.28209479177387814
"""The constant of band 0 of the spherical harmonics, as in `core.spherical_harmonics`, which needs torch."""
_MAX_HEADER_BYTES = 1 << 14
_FIELDS = ("x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_FIELDS += ("opacity", "f_dc_0", "f_dc_1", "f_dc_2")


@dataclass(frozen=True)
class SceneSample:
    """Some Gaussians of a scene in the raw parametrisation of its .ply, with constant colour."""

    means: Float[np.ndarray, "m 3"]
    """Centres, world units."""
    log_scales: Float[np.ndarray, "m 3"]
    """Natural logarithm of the enlarged standard deviations, world units."""
    quaternions: Float[np.ndarray, "m 4"]
    """Own axes in the world, wxyz."""
    opacity_logits: Float[np.ndarray, "m"]
    """Opacity before the sigmoid."""
    band_0: Float[np.ndarray, "m 3"]
    """Coefficients of the colour's band 0."""
    rows: Int[np.ndarray, "m"]
    """Row of each in the file."""
    total: int
    """Gaussians in the file."""

    @property
    def colors(self) -> Float[np.ndarray, "m 3"]:
        """sRGB in [0, 1]."""
        return (0.5 + np.float32(_C0) * self.band_0).clip(0, 1)

    def select(self, which: Bool[np.ndarray, "m"]) -> "SceneSample":
        """The Gaussians where the mask is true."""
        names = ("means", "log_scales", "quaternions", "opacity_logits", "band_0", "rows")
        return SceneSample(**{name: getattr(self, name)[which] for name in names}, total=self.total)

    def without(self, erased: Bool[np.ndarray, "n"]) -> "SceneSample":
        """The sample without the erased Gaussians of the file; the same one where the flags belong to another file."""
        return self.select(~erased[self.rows]) if len(erased) == self.total else self


@dataclass(frozen=True)
class View:
    """The view through a camera, as viser states it."""

    position: Float[np.ndarray, "3"]
    """World units."""
    look_at: Float[np.ndarray, "3"]
    """A point on the optical axis, at the typical distance between the cameras, world units."""
    up: Float[np.ndarray, "3"]
    """Up direction of the image, of length 1."""
    half_height: float
    """Tangent of half the vertical field of view."""
    aspect: float
    """Width over height."""


def sample_count(path: Path) -> int | None:
    """Number of Gaussians in a .ply as this program writes it; None for any other file."""
    found = _header(path)
    return None if found is None else found[1]


def read_sample(path: Path, *, most: int = SAMPLE_COUNT) -> SceneSample | None:
    """Evenly spaced Gaussians of a .ply as this program writes it.

    Args:
        path: The file.
        most: Maximum number of Gaussians.

    Returns:
        The sample; None where the file is missing, empty, of another layout, or shorter than its header says.
    """
    found = _header(path)
    if found is None:
        return None
    start, count, names = found
    dtype = np.dtype([(name, "<f4") for name in names])
    if count == 0 or path.stat().st_size < start + count * dtype.itemsize:
        return None
    rows = np.arange(min(most, count)) * count // max(1, min(most, count))
    # the whole file is not read: the pages of these rows are
    read = np.memmap(path, dtype, mode="r", offset=start, shape=(count,))[rows]
    columns = np.stack([read[name] for name in _FIELDS], axis=1)
    is_finite = np.isfinite(columns).all(axis=1) & (np.abs(columns[:, 6:10]).sum(axis=1) > 0)
    columns, rows = columns[is_finite], rows[is_finite]
    log_scales = _enlarged(columns[:, 3:6], (count / max(1, most)) ** 0.5)
    return SceneSample(
        columns[:, :3], log_scales, columns[:, 6:10], columns[:, 10], columns[:, 11:14], rows, total=count
    )


def read_first_view(transforms: Path) -> View | None:
    """The first camera of a transforms.json as this program writes it; None where there is none."""
    try:
        content = json.loads(transforms.read_text(encoding="utf-8"))
        frame = {**content, **content["frames"][0]}
        poses = np.array([one["transform_matrix"] for one in content["frames"]], np.float64).reshape(-1, 4, 4)
        width, height, focal = float(frame["w"]), float(frame["h"]), float(frame["fl_y"])
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return None
    if not (np.isfinite(poses).all() and min(width, height, focal) > 0):
        return None
    position, distance = poses[0, :3, 3], typical_distance(poses[:, :3, 3])
    # OpenGL axes: the view is along -z, and y is up
    look_at = position - distance * poses[0, :3, 2]
    return View(position, look_at, poses[0, :3, 1], height / (2 * focal), width / height)


def typical_distance(centers: Float[np.ndarray, "v 3"]) -> float:
    """Median distance of camera centres from their mean, world units; positive."""
    return max(1e-6, float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1))))


def _enlarged(log_scales: Float[np.ndarray, "m 3"], factor: float) -> Float[np.ndarray, "m 3"]:
    """Scales times a factor, but not beyond the size that the median Gaussian gets; no smaller than before."""
    if factor <= 1 or not len(log_scales):
        return log_scales
    largest, growth = log_scales.max(axis=1), np.log(_FILL * factor)
    room = np.maximum(0, np.median(largest) + growth - largest)
    return log_scales + np.minimum(growth, room)[:, None].astype(np.float32)


def _header(path: Path) -> tuple[int, int, list[str]] | None:
    """Offset of the rows, their number and their float properties."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_MAX_HEADER_BYTES)
    except OSError:
        return None
    found = re.match(
        rb"ply\nformat binary_little_endian 1\.0\n(?:comment [^\n]*\n)*"
        rb"element vertex ([0-9]{1,12})\n((?:property float \w+\n)+)end_header\n",
        head,
    )
    if found is None:
        return None
    names = [line.rpartition(b" ")[2].decode() for line in found[2].splitlines()]
    return (found.end(), int(found[1]), names) if set(_FIELDS) <= set(names) else None
