"""Lenses of photos that are not as large as the others: crops, whose optical axis does not meet their middle.

A camera starts as COLMAP's SIMPLE_RADIAL with the principal point in the middle of the photo. In a photo cut out of a
larger one it lies elsewhere, and a radial distortion around the middle bends to make up for it. Of such photos alone
the principal point is solved as well, and where that is not enough the four numbers of OPENCV's distortion: for all
photos these would trade against the poses.
"""

from pathlib import Path
from typing import Any

import numpy as np

from .features import copy_database, fresh
from .job import SEARCH


def crops(model: Any) -> dict[int, list[int]]:
    """Posed photos by camera, of the cameras whose photos have another size than most; none where these are not fewer.

    A photo taken upright has the size of one taken across. A camera whose photos see too few points is left out.
    """
    images: dict[int, list[int]] = {}
    for i in sorted(model.reg_image_ids()):
        images.setdefault(model.images[i].camera_id, []).append(i)
    count: dict[tuple[int, int], int] = {}
    for camera, posed in images.items():
        count[_size(model, camera)] = count.get(_size(model, camera), 0) + len(posed)
    usual = max(count, key=lambda size: count[size], default=None)
    if usual is None or 2 * count[usual] <= sum(count.values()):
        return {}
    return {
        camera: posed
        for camera, posed in images.items()
        if _size(model, camera) != usual
        and sum(model.images[i].num_points3D for i in posed) >= SEARCH.lens_observations
    }


def _size(model: Any, camera: int) -> tuple[int, int]:
    """Longer and shorter side, pixels."""
    sides = sorted((model.cameras[camera].width, model.cameras[camera].height))
    return sides[1], sides[0]


def with_full_lenses(database: Path, target: Path, cameras: set[int]) -> Path:
    """A copy of `database` at `target` in which `cameras` have OPENCV's lens."""
    import pycolmap

    copy_database(database, fresh(target))
    with pycolmap.Database.open(target) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in cameras:
                params = lens_numbers(camera)
                camera.model = pycolmap.CameraModelId.OPENCV
                camera.params = params
                opened.update_camera(camera)
    return target


def lens_numbers(camera: Any) -> list[float]:
    """fx, fy, cx, cy, k1, k2, p1, p2 of a camera with a SIMPLE_RADIAL or OPENCV lens."""
    numbers = camera.params.tolist()
    if len(numbers) == 8:
        return numbers
    f, cx, cy, k = numbers
    return [f, f, cx, cy, k, 0.0, 0.0, 0.0]


def params_as(camera: Any, other: Any) -> list[float]:
    """The parameters of `other` for the kind of lens that `camera` has, which is the same or the fuller one."""
    return other.params.tolist() if camera.model == other.model else lens_numbers(other)


def mean_error_px(model: Any, images: list[int]) -> float:
    """Mean reprojection error over what the photos see, pixels."""
    errors: list[float] = []
    for i in images:
        image = model.images[i]
        camera, camera_from_world = model.cameras[image.camera_id], image.cam_from_world()
        seen = [point for point in image.points2D if point.has_point3D()]
        found = [camera.img_from_cam(camera_from_world * model.points3D[point.point3D_id].xyz) for point in seen]
        errors += [float(np.linalg.norm(x - p.xy)) for x, p in zip(found, seen, strict=True) if x is not None]
    return float(np.mean(errors)) if errors else float("inf")


def describe_crop(model: Any, camera: int, images: list[int]) -> str:
    """A sentence for people."""
    found = model.cameras[camera]
    _, _, cx, cy, *_ = lens_numbers(found)
    names = ", ".join(Path(model.images[i].name).stem for i in images)
    right, below = cx - found.width / 2, cy - found.height / 2
    across, down = "right" if right >= 0 else "left", "below" if below >= 0 else "above"
    return (
        f"{names}: of another size than most photos, so the lens was solved apart: its axis lies {abs(right):.0f} px "
        f"{across} of the middle and {abs(below):.0f} px {down} it"
    )
