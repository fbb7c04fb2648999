"""From view records to `Cameras` and `PosedImages`: image sizes checked against the files, distortion, masks."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import stored_size
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.masks import with_masks
from splatgraft.formats.captures.view_record import MAX_SIDE, ViewRecord, same_shape


def posed_images_of(
    views: Sequence[ViewRecord],
    source: Path,
    *,
    folder: Path,
    points: Float[Tensor, "m 3"],
    colors: Float[Tensor, "m 3"],
) -> PosedImages:
    """The capture of `views`.

    Args:
        views: One per photograph.
        source: The file that describes them, for error messages.
        folder: Where masks/ is looked for.
        points: Sparse points, world units.
        colors: Of the points, sRGB in [0, 1].

    Raises:
        ValueError: Where an image is missing, or does not fit its camera or mask.
    """
    for view in views:
        if view.image_path is None:
            raise ValueError(f"{source}: expected the image file {view.name}, found none in {folder}")
    fitted = with_masks([fitted_to_file(view, source) for view in views], folder)
    cameras, distortions = cameras_of(fitted, source)
    return PosedImages(
        image_paths=tuple(view.image_path for view in fitted if view.image_path),
        cameras=cameras,
        points=points,
        point_colors=colors,
        mask_paths=tuple(view.mask_path for view in fitted) if any(view.mask_path for view in fitted) else (),
        distortions=distortions if any(distortions) else (),
    )


def fitted_to_file(view: ViewRecord, source: Path) -> ViewRecord:
    """The view with intrinsics for its file's size, where that is smaller than the camera's and of the same shape.

    For a larger file of the same shape the camera's size stays: the image is resampled on reading.

    Raises: ValueError where the shapes differ.
    """
    if view.image_path is None:
        return view
    (width, height), (file_width, file_height) = view.size, stored_size(view.image_path)
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
