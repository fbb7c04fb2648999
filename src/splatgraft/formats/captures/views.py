"""The value `ViewRecord`, a photograph with its camera as a capture file describes it, and captures made of them.

- Image sizes are checked against the image files.
- Distortion is separated from pinhole cameras.
- Masks are found.
- Views that fail are left out, with the reason.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import same_shape, stored_size
from splatgraft.core.posed_images import LeftOut, PosedImages
from splatgraft.formats.captures.masks import check_mask, masks_of

MIN_SHARE = 0.5
"""Minimum share of a capture's images, and of its masks, that must be usable; below, it is likely the wrong folder."""

_RIGID_TOLERANCE = 1e-3  # largest entry of R^T R - I; accepts matrices printed with four digits

MAX_SIDE = 32766
"""Longest image side, pixels: OpenCV cannot undistort longer ones."""


@dataclass(frozen=True)
class ViewRecord:
    """One photograph with its camera, as a capture file describes it."""

    name: str
    """Path of the image in the capture file."""
    image_path: Path | None
    """Image file; None if it does not exist."""
    world_from_camera: np.ndarray
    """Rigid pose (4, 4), OpenCV axes."""
    focal: tuple[float, float]
    """Focal lengths fx, fy, pixels of `size`."""
    center: tuple[float, float]
    """Principal point cx, cy, pixels of `size`, pixel centres at +0.5."""
    size: tuple[int, int]
    """Width and height, pixels."""
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, p1, p2, k3."""
    mask_path: Path | None = None


@dataclass(frozen=True)
class CaptureFile:
    """A capture as its file describes it."""

    source: Path
    """File name for messages."""
    folder: Path
    """Folder in which masks/ is searched."""
    views: Sequence[ViewRecord | LeftOut]
    """View of each photograph, or the reason why it is left out."""
    points: Callable[[], tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]] = lambda: (
        torch.zeros(0, 3),
        torch.zeros(0, 3),
    )
    """Reader of sparse points, world units, and their colours, sRGB in [0, 1]."""

    def records(self) -> list[ViewRecord]:
        """Return all views, or raise ValueError if one is left out."""
        for view in self.views:
            if isinstance(view, LeftOut):
                raise ValueError(view.reason)
        return [view for view in self.views if isinstance(view, ViewRecord)]


def rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """Check a pose (4, 4), and make its rotation orthonormal in float64."""
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


def existing_file(path: Path) -> Path | None:
    """Return `path` if it is a file, else None, also for invalid file names."""
    try:
        return path if path.is_file() else None
    except (OSError, ValueError):
        return None


def posed_images(file: CaptureFile, *, with_points: bool = True) -> PosedImages:
    """Make a capture of the views whose image is readable and fits its camera."""

    def usable(view: ViewRecord) -> ViewRecord:
        if view.image_path is None:
            raise ValueError(f"{file.source}: expected the image file {view.name}, found none in {file.folder}")
        fitted = fitted_to_file(view, file.source)
        _pinhole(fitted, file.source)
        return fitted

    checked = [v if isinstance(v, LeftOut) else view_or_reason(v.name, partial(usable, v)) for v in file.views]
    left_out = [view for view in checked if isinstance(view, LeftOut)]
    kept = [view for view in checked if isinstance(view, ViewRecord)]
    _require_share(len(kept), left_out, "images", file.source)
    fitted, without_mask = _with_masks(kept, file.folder)
    _require_share(sum(view.mask_path is not None for view in fitted), without_mask, "masks", file.source)
    cameras, distortions = _cameras_of(fitted, file.source)
    points, colors = file.points() if with_points else (torch.zeros(0, 3),) * 2
    return PosedImages(
        image_paths=tuple(view.image_path for view in fitted if view.image_path),
        cameras=cameras,
        points=points,
        point_colors=colors,
        mask_paths=tuple(view.mask_path for view in fitted) if any(view.mask_path for view in fitted) else (),
        distortions=distortions if any(distortions) else (),
        left_out=(*left_out, *without_mask),
    )


def cameras(file: CaptureFile) -> Cameras:
    """Make the pinhole cameras of the undistorted views; images need not exist."""
    return _cameras_of([fitted_to_file(view, file.source) for view in file.records()], file.source)[0]


def view_or_reason(name: str, read: Callable[[], ViewRecord]) -> ViewRecord | LeftOut:
    """Return the view that `read` gives, or the reason why its values are unusable."""
    try:
        return read()
    except ValueError as error:
        return LeftOut(name, str(error))


def _with_masks(views: list[ViewRecord], folder: Path) -> tuple[list[ViewRecord], list[LeftOut]]:
    """Add masks to the views; unreadable masks and those of another shape are left out, with the reason.

    Masks that views already have stay.
    """
    if not any(view.mask_path for view in views):
        masks = masks_of({view.image_path: view.name for view in views if view.image_path is not None}, [folder])
        views = [replace(view, mask_path=masks.get(view.image_path) if view.image_path else None) for view in views]
    left_out: list[LeftOut] = []
    for index, view in enumerate(views):
        if view.mask_path is None or view.mask_path == view.image_path:
            continue
        try:
            check_mask(view.mask_path, view.size)
        except ValueError as error:
            left_out.append(LeftOut(view.name, str(error), mask_only=True))
            views[index] = replace(view, mask_path=None)
    return views, left_out


def _require_share(kept: int, left_out: Sequence[LeftOut], what: str, source: Path) -> None:
    """Raise ValueError with the first reason if less than `MIN_SHARE` is left."""
    total = kept + len(left_out)
    if not left_out or kept >= MIN_SHARE * total:
        return
    if len(left_out) == total:
        raise ValueError(left_out[0].reason)
    raise ValueError(
        f"{source}: expected at least {MIN_SHARE:.0%} of {total} {what} to be usable, found {kept}; "
        f"the first of the others: {left_out[0].reason}"
    )


def fitted_to_file(view: ViewRecord, source: Path) -> ViewRecord:
    """Scale a view's intrinsics to the size of its file, if that is smaller than the camera's and of the same shape.

    If the file is larger, the camera's size stays, because the image is resampled on reading.
    """
    if view.image_path is None:
        return view
    (width, height), size = view.size, stored_size(view.image_path, view.size)
    found = f"found {size[0]}x{size[1]}"
    if max(size) > MAX_SIDE:
        raise ValueError(f"{view.image_path}: expected sides up to {MAX_SIDE} px, {found}")
    if not same_shape(view.size, size):
        raise ValueError(f"{view.image_path}: expected {width}x{height} px, as in {source}, or those scaled, {found}")
    if size[0] >= width:
        return view
    x, y = size[0] / width, size[1] / height
    focal, center = (view.focal[0] * x, view.focal[1] * y), (view.center[0] * x, view.center[1] * y)
    return replace(view, size=size, focal=focal, center=center)


def _cameras_of(views: Sequence[ViewRecord], source: Path) -> tuple[Cameras, tuple[Distortion | None, ...]]:
    """Make the pinhole cameras of the undistorted views, and the distortion of each file."""
    found = [_pinhole(view, source) for view in views]
    intrinsics = np.array([matrix for matrix, _ in found]).reshape(-1, 3, 3)
    cameras = Cameras(
        world_from_camera=torch.tensor(np.array([v.world_from_camera for v in views])).reshape(-1, 4, 4).float(),
        intrinsics=torch.tensor(intrinsics).float(),
        sizes=torch.tensor([v.size for v in views], dtype=torch.int64).reshape(-1, 2),
        names=_unique_names(views, source),
    )
    return cameras, tuple(distortion for _, distortion in found)


def _pinhole(view: ViewRecord, source: Path) -> tuple[np.ndarray, Distortion | None]:
    """Compute the intrinsics of the undistorted view, and its distortion."""
    numbers = np.array([*view.focal, *view.center, *view.distortion])
    if not np.isfinite(numbers).all() or min(view.focal) <= 0 or np.abs(numbers).max() > 1e7:
        raise ValueError(
            f"{source}: {view.name}: expected finite intrinsics with a focal length above 0, "
            f"found {', '.join(f'{number:.4g}' for number in numbers)}"
        )
    matrix = np.array([[view.focal[0], 0, view.center[0]], [0, view.focal[1], view.center[1]], [0, 0, 1]])
    if not any(view.distortion):
        return matrix, None
    coefficients = torch.tensor(view.distortion, dtype=torch.float64)
    distortion = Distortion(torch.tensor(matrix), coefficients, view.size)
    try:
        return distortion.pinhole(), distortion
    except ValueError as error:
        raise ValueError(f"{source}: {view.name}: {error}") from None


def _unique_names(views: Sequence[ViewRecord], source: Path) -> tuple[str, ...]:
    """Name views by their files and as few folders as make the names unique, joined by underscores."""
    parts = [[p for p in Path(v.image_path or v.name).parts if p not in ("..", ".", "/")] for v in views]
    for depth in range(1, 1 + max(map(len, parts), default=0)):
        names = tuple("_".join(part[-depth:]) for part in parts)
        if len(set(names)) == len(names):
            return names
    twice = next((view.name for i, view in enumerate(views) if parts[i] in parts[:i]), views[0].name)
    raise ValueError(f"{source}: expected each image once, found {twice} twice")
