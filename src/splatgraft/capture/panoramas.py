"""360-degree panoramas: recognition, and the views that are cut out of them.

COLMAP poses whole panoramas (equirectangular, +z in the middle, +x right, +y down). Each gives eight views of 90
degrees: four towards the horizon and four 45 degrees up, so that the whole sky is in them. The person or the tripod
that carries the camera is below: directions more than 45 degrees below the horizon are in no view and have no features.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch
from jaxtyping import Float
from PIL.ExifTags import IFD, Base
from torch import Tensor

from splatgraft.core.images import opened, read_rgb, read_stored_rgb, stored_size, write_image

CUT_BELOW = 0.75  # share of the rows, from the top, that features are taken from: down to 45 degrees below the horizon
_RATIO, _TOLERANCE = 2.0, 0.01  # width over height of a sphere
_FLAT_RATIO = 2.5  # width over height above which a picture is a phone's flat panorama; cinema's format has 2.4
_PANORAMA_MARK = 6  # value of EXIF's CustomRendered in panoramas of iPhones
_READ_PX = 512  # width at which a picture is examined
# limits that none of 169 photos of our captures passes, cut to 2:1
_SEAM = 3.0  # largest step from the last column to the first, over the 90th percentile of steps between neighbours
_POLE = 0.3  # largest deviation within the first or the last row, each one point of a sphere, over the picture's


def are_panoramas(photos: Sequence[Path]) -> bool:
    """Whether photos are 360-degree panoramas.

    Raises:
        ValueError: One is a flat panorama, only some go all round, or these differ in size.
    """
    sizes = {photo: stored_size(photo) for photo in photos}
    wide = [photo for photo, (width, height) in sizes.items() if width >= (_RATIO - _TOLERANCE) * height]
    round_ones = [photo for photo in wide if _is_sphere(photo, sizes[photo])]
    for photo in wide:
        width, height = sizes[photo]
        if photo not in round_ones and (width > _FLAT_RATIO * height or _is_marked(photo)):
            raise ValueError(
                f"{photo}: expected a photo, or a 360-degree panorama of 2:1 whose edges meet, found a flat panorama "
                f"of {width} x {height}; take single photos instead"
            )
    if not round_ones:
        return False
    if len(round_ones) < len(photos):
        other = next(photo for photo in photos if photo not in round_ones)
        raise ValueError(f"{other}: expected a 360-degree panorama like {round_ones[0].name}, found another photo")
    if len(found := {sizes[photo] for photo in round_ones}) > 1:
        listed = ", ".join(f"{width} x {height}" for width, height in sorted(found))
        raise ValueError(f"{round_ones[0].parent}: expected panoramas of one size, found {listed}")
    return True


def _is_sphere(photo: Path, size: tuple[int, int]) -> bool:
    if size[0] > (_RATIO + _TOLERANCE) * size[1]:
        return False
    pixels = read_stored_rgb(photo, longest_px=_READ_PX)
    steps = (pixels - pixels.roll(-1, 1)).abs().mean((0, 2))
    poles = pixels[[0, -1]].std(1).mean(1).max()
    return bool(steps[-1] <= _SEAM * steps[:-1].quantile(0.9)) and bool(poles <= _POLE * pixels.std((0, 1)).mean())


def _is_marked(photo: Path) -> bool:
    """Whether EXIF says that a picture is a panorama."""
    with opened(photo) as image:
        return image.getexif().get_ifd(IFD.Exif).get(Base.CustomRendered) == _PANORAMA_MARK


def panorama_from_views() -> Float[Tensor, "8 4 4"]:
    """Return the poses of the views in the axes of their panorama."""
    yaw = math.pi / 2 * torch.arange(8)
    pitch = torch.where(torch.arange(8) < 4, 0.0, math.pi / 4)
    forward = torch.stack([yaw.sin() * pitch.cos(), -pitch.sin(), yaw.cos() * pitch.cos()], 1)
    right = torch.stack([yaw.cos(), torch.zeros(8), -yaw.sin()], 1)
    poses = torch.eye(4).repeat(8, 1, 1)
    poses[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 2)
    return poses


def cut_views(panorama: Path, folder: Path) -> list[Path]:
    """Write the views of a panorama to a folder, as square JPEGs a quarter as wide as it; returns their files."""
    pixels = read_rgb(panorama).numpy()
    height, width, _ = pixels.shape
    place = (torch.arange(width // 4) + 0.5) / (width // 4) * 2 - 1
    down, across = torch.meshgrid(place, place, indexing="ij")
    rays = torch.stack([across, down, torch.ones_like(down)], -1)
    files = [folder / f"{panorama.stem}_{index}.jpg" for index in range(8)]
    for file, pose in zip(files, panorama_from_views(), strict=True):
        x, y, z = (rays @ pose[:3, :3].T).unbind(-1)
        column = (0.5 + torch.atan2(x, z) / (2 * math.pi)) * width - 0.5
        row = ((0.5 + torch.atan2(y, torch.hypot(x, z)) / math.pi) * height - 0.5).clamp(0, height - 1)
        view = cv2.remap(pixels, column.numpy(), row.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        write_image(file, torch.from_numpy(view))
    return files
