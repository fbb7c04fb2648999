"""The value `ViewRecord`: one photograph with its camera, as a capture file describes it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

_RIGID_TOLERANCE = 1e-3
"""Largest entry of R^T R - I; allows matrices printed with four digits."""

MAX_SIDE = 32766
"""Longest image side, pixels: OpenCV cannot undistort longer ones."""


@dataclass(frozen=True)
class ViewRecord:
    """One photograph with its camera, as a capture file describes it."""

    name: str
    """Path of the image as the capture writes it."""
    image_path: Path | None
    """The image file; None where it does not exist."""
    world_from_camera: np.ndarray
    """(4, 4), rigid, OpenCV axes."""
    focal: tuple[float, float]
    """fx, fy, pixels of `size`."""
    center: tuple[float, float]
    """cx, cy, pixels of `size`, pixel centres at +0.5."""
    size: tuple[int, int]
    """Width, height."""
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 as in OpenCV."""
    mask_path: Path | None = None


def rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """The pose (4, 4) with its rotation made orthonormal in float64.

    Raises: ValueError that starts with `where`, for a matrix that is not a rotation and a translation.
    """
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e30:
        raise ValueError(f"{where}: expected a pose of finite numbers, found nan, infinity or more than 1e30")
    if not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise ValueError(f"{where}: expected a pose with the last row 0 0 0 1, found {matrix[3].tolist()}")
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > _RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        scales = ", ".join(f"{s:.4g}" for s in np.linalg.norm(rotation, axis=0))
        raise ValueError(
            f"{where}: expected a rotation and a translation, "
            f"found axes of length {scales} and determinant {np.linalg.det(rotation):.4g}"
        )
    if error < 1e-6:
        return matrix
    out = matrix.copy()
    u, _, vt = np.linalg.svd(rotation)
    out[:3, :3] = u @ vt
    return out


def turn_about(axis: int, radians: float) -> np.ndarray:
    """The rotation (3, 3) by an angle, counterclockwise about a positive axis, x, y or z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = np.cos(radians)
    turn[j, i], turn[i, j] = np.sin(radians), -np.sin(radians)
    return turn


def existing_file(path: Path) -> Path | None:
    """`path` where it is a file, otherwise None, also for invalid file names."""
    try:
        return path if path.is_file() else None
    except (OSError, ValueError):
        return None
