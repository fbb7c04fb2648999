"""From views to cameras and posed images: sizes held against the files, distortion, masks. Knows no file format."""

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
from splatgraft.formats.captures.described_view import MAX_SIDE, View, same_shape
from splatgraft.formats.captures.masks import with_masks


def posed_images_of(
    views: Sequence[View], source: Path, *, folder: Path, points: Float[Tensor, "m 3"], colors: Float[Tensor, "m 3"]
) -> PosedImages:
    """The capture of `views` that the file `source` describes, with the masks in `folder`.

    Raises: ValueError where an image is missing, or does not fit its camera or mask.
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


def fitted_to_file(view: View, source: Path) -> View:
    """The view with the intrinsics of its file's size, where that is an exact downscale of the camera's.

    A larger file of the same shape keeps the camera's size: it is resampled when it is read.

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
    """File names; where folders share one, with as many folders in front as it takes. Each could name a file itself."""
    parts = [[p for p in Path(v.image_path or v.name).parts if p not in ("..", ".", "/")] for v in views]
    for depth in range(1, 1 + max(map(len, parts), default=0)):
        names = tuple("_".join(part[-depth:]) for part in parts)
        if len(set(names)) == len(names):
            return names
    twice = next((view.name for i, view in enumerate(views) if parts[i] in parts[:i]), views[0].name)
    raise ValueError(f"{source}: expected each image once, found {twice} twice")
