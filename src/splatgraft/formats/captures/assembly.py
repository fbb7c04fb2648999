"""From view records to `Cameras` and `PosedImages`: image sizes checked against the files, distortion, masks."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import same_shape, stored_size
from splatgraft.core.posed_images import LeftOut, PosedImages
from splatgraft.formats.captures.masks import with_masks
from splatgraft.formats.captures.view_record import MAX_SIDE, ViewRecord

LEAST_SHARE = 0.5
"""Of the images that a capture names and of its masks; with fewer, the folder is not the one that was meant."""


def posed_images_of(
    views: Sequence[ViewRecord | LeftOut],
    source: Path,
    *,
    folder: Path,
    points: Float[Tensor, "m 3"],
    colors: Float[Tensor, "m 3"],
) -> PosedImages:
    """The capture of `views`, without those whose image is missing or unreadable or does not fit its camera.

    Args:
        views: One per photograph, or why it is left out already.
        source: The file that describes them, for error messages.
        folder: Where masks/ is looked for.
        points: Sparse points, world units.
        colors: Of the points, sRGB in [0, 1].

    Raises:
        ValueError: Where fewer than half of the views or of their masks are left, or an image is named twice.
    """
    checked = [view if isinstance(view, LeftOut) else _usable(view, source, folder) for view in views]
    left_out = [view for view in checked if isinstance(view, LeftOut)]
    kept = [view for view in checked if isinstance(view, ViewRecord)]
    _require_share(len(kept), left_out, "images", source)
    fitted, without_mask = with_masks(kept, folder)
    _require_share(sum(view.mask_path is not None for view in fitted), without_mask, "masks", source)
    cameras, distortions = cameras_of(fitted, source)
    return PosedImages(
        image_paths=tuple(view.image_path for view in fitted if view.image_path),
        cameras=cameras,
        points=points,
        point_colors=colors,
        mask_paths=tuple(view.mask_path for view in fitted) if any(view.mask_path for view in fitted) else (),
        distortions=distortions if any(distortions) else (),
        left_out=(*left_out, *without_mask),
    )


def view_or_reason(name: str, read: Callable[[], ViewRecord]) -> ViewRecord | LeftOut:
    """The view that `read` gives, or, where its values are not usable, why it is left out."""
    try:
        return read()
    except ValueError as error:
        return LeftOut(name, str(error))


def _require_share(kept: int, left_out: Sequence[LeftOut], what: str, source: Path) -> None:
    """Raises: ValueError with the first reason, where less than `LEAST_SHARE` is left."""
    total = kept + len(left_out)
    if not left_out or kept >= LEAST_SHARE * total:
        return
    if len(left_out) == total:
        raise ValueError(left_out[0].reason)
    raise ValueError(
        f"{source}: expected at least {LEAST_SHARE:.0%} of {total} {what} to be usable, found {kept}; "
        f"the first of the others: {left_out[0].reason}"
    )


def _usable(view: ViewRecord, source: Path, folder: Path) -> ViewRecord | LeftOut:
    def read() -> ViewRecord:
        if view.image_path is None:
            raise ValueError(f"{source}: expected the image file {view.name}, found none in {folder}")
        fitted = fitted_to_file(view, source)
        _pinhole(fitted, source)
        return fitted

    return view_or_reason(view.name, read)


def fitted_to_file(view: ViewRecord, source: Path) -> ViewRecord:
    """The view with intrinsics for its file's size, where that is smaller than the camera's and of the same shape.

    For a larger file of the same shape the camera's size stays: the image is resampled on reading.

    Raises: ValueError where the shapes differ.
    """
    if view.image_path is None:
        return view
    (width, height), (file_width, file_height) = view.size, stored_size(view.image_path, view.size)
    if max(file_width, file_height) > MAX_SIDE:
        raise ValueError(f"{view.image_path}: expected sides up to {MAX_SIDE} px, found {file_width}x{file_height}")
    if (width, height) == (file_width, file_height):
        return view
    if not same_shape((width, height), (file_width, file_height)):
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


def cameras_of(views: Sequence[ViewRecord], source: Path) -> tuple[Cameras, tuple[Distortion | None, ...]]:
    """The pinhole cameras of the undistorted views, and the distortion of each file.

    Raises: ValueError that names `source`, for invalid intrinsics.
    """
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
    """Intrinsics of the undistorted view, and its distortion."""
    distortion = _distortion(view, source)
    if distortion is None:
        return _matrix(view), None
    try:
        return distortion.pinhole(), distortion
    except ValueError as error:
        raise ValueError(f"{source}: {view.name}: {error}") from None


def _matrix(view: ViewRecord) -> np.ndarray:
    return np.array([[view.focal[0], 0, view.center[0]], [0, view.focal[1], view.center[1]], [0, 0, 1]])


def _distortion(view: ViewRecord, source: Path) -> Distortion | None:
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


def _unique_names(views: Sequence[ViewRecord], source: Path) -> tuple[str, ...]:
    """File names, prefixed by as many folders as make them unique, joined by underscores."""
    parts = [[p for p in Path(v.image_path or v.name).parts if p not in ("..", ".", "/")] for v in views]
    for depth in range(1, 1 + max(map(len, parts), default=0)):
        names = tuple("_".join(part[-depth:]) for part in parts)
        if len(set(names)) == len(names):
            return names
    twice = next((view.name for i, view in enumerate(views) if parts[i] in parts[:i]), views[0].name)
    raise ValueError(f"{source}: expected each image once, found {twice} twice")
