"""What every capture format says of its photographs, and how that becomes cameras. Knows no file format."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from splatgraft.cameras import Cameras
from splatgraft.distortion import Distortion
from splatgraft.images import image_size

_RIGID_TOLERANCE = 1e-3
"""Largest entry of R^T R - I: room for matrices printed with four digits."""


@dataclass(frozen=True)
class View:
    """One photograph as its capture describes it."""

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
    """The pose (4, 4) with a rotation that is orthonormal to float64.

    Raises: ValueError that starts with `where`, for a matrix that is no rotation and translation.
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


def fitted_to_file(view: View, source: Path) -> View:
    """The view with the intrinsics of its file's size, where that is an exact downscale of the camera's.

    A larger file of the same shape keeps the camera's size: it is resampled when it is read.

    Raises: ValueError where the shapes differ.
    """
    if view.image_path is None:
        return view
    (width, height), (file_width, file_height) = view.size, image_size(view.image_path)
    if (width, height) == (file_width, file_height):
        return view
    # both sides scaled by one factor and rounded: the cross products differ by at most one longer side
    if abs(file_width * height - file_height * width) > max(width, height, file_width, file_height):
        raise ValueError(
            f"{view.image_path}: expected {width}x{height} px, as in {source}, or those scaled, "
            f"found {file_width}x{file_height}"
        )
    if file_width >= width:
        return view
    x, y = file_width / width, file_height / height
    return replace(
        view,
        size=(file_width, file_height),
        focal=(view.focal[0] * x, view.focal[1] * y),
        center=(view.center[0] * x, view.center[1] * y),
    )


def cameras_of(views: Sequence[View], source: Path) -> tuple[Cameras, tuple[Distortion | None, ...]]:
    """The pinholes at which the views are served, and what stands between them and the files.

    Raises: ValueError that names `source`, for intrinsics that no camera has.
    """
    distortions = tuple(_distortion(view, source) for view in views)
    intrinsics = np.empty((len(views), 3, 3))
    for i, (view, distortion) in enumerate(zip(views, distortions, strict=True)):
        if distortion is None:
            intrinsics[i] = _matrix(view)
            continue
        try:
            intrinsics[i] = distortion.pinhole()
        except ValueError as error:
            raise ValueError(f"{source}: {view.name}: {error}") from None
    cameras = Cameras(
        world_from_camera=torch.tensor(np.array([v.world_from_camera for v in views])).reshape(-1, 4, 4).float(),
        intrinsics=torch.tensor(intrinsics).float(),
        sizes=torch.tensor([v.size for v in views], dtype=torch.int64).reshape(-1, 2),
        names=_unique_names(views, source),
    )
    return cameras, distortions


def _matrix(view: View) -> np.ndarray:
    return np.array([[view.focal[0], 0, view.center[0]], [0, view.focal[1], view.center[1]], [0, 0, 1]])


def _distortion(view: View, source: Path) -> Distortion | None:
    numbers = np.array([*view.focal, *view.center, *view.distortion])
    if not np.isfinite(numbers).all() or min(view.focal) <= 0 or np.abs(numbers).max() > 1e7:
        raise ValueError(
            f"{source}: {view.name}: expected finite intrinsics with a focal length above 0, "
            f"found {', '.join(f'{number:.4g}' for number in numbers)}"
        )
    if not any(view.distortion):
        return None
    return Distortion(
        intrinsics=torch.tensor(_matrix(view)),
        coefficients=torch.tensor(view.distortion, dtype=torch.float64),
        size=view.size,
    )


def _unique_names(views: Sequence[View], source: Path) -> tuple[str, ...]:
    """File names, or whole paths where two folders share a file name."""
    short = tuple(Path(v.image_path or v.name).name for v in views)
    if len(set(short)) == len(short):
        return short
    whole = tuple(v.name for v in views)
    if len(set(whole)) < len(whole):
        twice = next(name for name in whole if whole.count(name) > 1)
        raise ValueError(f"{source}: expected each image once, found {twice} twice")
    return whole
