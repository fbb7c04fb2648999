"""Reads the registration that RealityScan (once RealityCapture) exports as CSV: poses and lenses, no points.

    #name, x, y, alt, heading, pitch, roll, f, px, py, k1, k2, k3, k4, t1, t2

One row a photo ("Internal/External camera parameters"). x, y and alt point east, north and up. With all angles 0 the
camera looks down, its top to the north; then come roll about y, pitch about x, and heading, clockwise from above.
Lengths of the lens are shares of the photo's longer side: f is in millimetres of a film 36 mm wide, px and py (the
principal point from the middle) are the shares themselves. k and t are Brown's radial and tangential terms. As the
reader of nerfstudio (Apache 2.0), process_data/realitycapture_utils.py, takes them.
"""

import csv
import math
from collections.abc import Mapping
from pathlib import Path, PureWindowsPath

import numpy as np

from splatgraft.formats.captures.view_record import ViewRecord, rigid, turn_about

_POSE = ("x", "y", "alt", "heading", "pitch", "roll")
_LENS = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FILM = 36.0
"""Millimetres."""
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def read_views(path: Path, sizes: Mapping[str, tuple[int, int]]) -> list[ViewRecord]:
    """The cameras of a file, in its order, without images.

    Args:
        path: The file.
        sizes: Width and height in pixels by the photos' names without suffix; a photo that is not among them gets a
            size of 36 x 36 px.

    Raises:
        ValueError: The file is no such export, a number is none, or a lens is not supported.
    """
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
        rows = list(csv.DictReader(stream, skipinitialspace=True))
    columns = [] if not rows else [name for name in rows[0] if name]
    missing = [name for name in ("#name", *_POSE, "f") if name not in columns]
    if missing:
        raise ValueError(
            f"{path}: expected RealityScan's CSV with columns #name, {', '.join((*_POSE, 'f'))}, found no {missing[0]}"
        )
    return [_view(path, row, sizes) for row in rows]


def _view(path: Path, row: Mapping[str, str], sizes: Mapping[str, tuple[int, int]]) -> ViewRecord:
    name = row["#name"]
    x, y, alt, heading, pitch, roll = (_number(path, name, row, key) for key in _POSE)
    f, px, py, k1, k2, k3, k4, t1, t2 = (_number(path, name, row, key) for key in _LENS)
    if f <= 0 or k4:
        found = f"f = {f:g}, k4 = {k4:g}"
        raise ValueError(f"{path}: expected f above 0 and k4 of 0 for {name}, found {found}; export undistorted photos")
    width, height = sizes.get(PureWindowsPath(name).stem, (36, 36))
    longer = max(width, height)
    pose = np.eye(4)
    heading, pitch, roll = np.radians((heading, pitch, roll))
    pose[:3, :3] = turn_about(2, -heading) @ turn_about(0, pitch) @ turn_about(1, roll)
    pose[:3, 3] = (x, y, alt)
    return ViewRecord(
        name=name,
        image_path=None,
        world_from_camera=rigid(pose @ _OPENCV_FROM_OPENGL, f"{path}: {name}"),
        focal=(f * longer / _FILM, f * longer / _FILM),
        center=(width / 2 + px * longer, height / 2 + py * longer),
        size=(width, height),
        distortion=(k1, k2, t1, t2, k3),
    )


def _number(path: Path, name: str, row: Mapping[str, str], key: str) -> float:
    """Of one column; 0 for a column of the lens that is not there."""
    text = row.get(key)
    if text is None and key in _LENS:
        return 0.0
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}: expected a finite number as {key} of {name}, found {(text or '')[:40]!r}")
    return value
