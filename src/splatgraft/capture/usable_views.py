"""Selection of the usable photos, masks and views of a capture, with a reason against each of the others.

- Photos are left out if they are unreadable, tiny, a copy of another, or far more blurred than the others.
- Masks are left out if they are unreadable, of another shape than the photo, or uniform.
- Views must be numerous and far enough apart to reconstruct from.

Sharpness is the ratio of fine to coarse detail, which depends little on the subject: mean square second differences at
full size over those at a sixteenth of it. The direction of the smallest ratio counts, because camera motion blurs in
one direction only.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import ImageOps
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import focus_point
from splatgraft.core.images import opened, read_mask, shrink_on_decoding, stored_size
from splatgraft.core.posed_images import LeftOut, PosedImages
from splatgraft.formats.captures.masks import PhotoFiles, check_mask
from splatgraft.runtime.progress import Progress, silent

MIN_VIEWS = 8
"""Smallest number of different photos or views: in a ring of 8, one every 45 degrees, three see each surface."""
_MIN_PARALLAX_DEG = 3.0  # smallest parallax: 1 px of error at a focal length of 1000 px is 2% of the distance
_POINTS, _CAMERAS = 256, 128  # most points and cameras whose parallax is measured, evenly spaced in their order
_SUBJECT_SHARE = 0.8  # smallest share of cameras that show a subject; 1 in captures of one, at most 0.31 from drones
_MIN_SIDE_PX = 16  # shorter side; smaller photos hold no window of SSIM (11 px) and no features
_MEASURED_PX = 800
"""Longest side at which sharpness is measured, or the median photo's if that is smaller: larger photos are compared at
the size of the others."""
_BLUR_OCTAVES = 1.5
"""Smallest difference of a blurred photo's sharpness from the median, octaves. In four captures (three photographed,
one rendered) the softest photo lies 0.4 to 0.8 below the median. Motion blur of 9 px or a Gaussian blur of 2 px costs
1.5 to 3, mostly 2.4."""
_BLUR_DEVIATIONS = 4.0  # the same in robust standard deviations (1.4826 median absolute deviations)
_COARSE_HALVINGS = 4  # to a sixteenth, whose detail survives blurs of up to 16 px; else a wide blur would pass
_COARSE_PX = 8  # smallest side at that size for a meaningful measurement
_THUMBNAIL_PX = 64
_COPY_LEVELS = 4.0
"""Largest grey level difference (of 255) between thumbnails of the same picture: that of a JPEG saved again. Another
viewpoint moves edges by much more."""


@dataclass(frozen=True)
class _Photo:
    path: Path
    sharpness: float
    """Sharpness, octaves (see `log_sharpness`)."""
    thumbnail: np.ndarray
    """Grey levels of the reduced photo, float32."""


def usable_photos(
    photos: Sequence[Path], name: str, *, keep_odd: bool = False, progress: Progress = silent
) -> tuple[list[Path], tuple[LeftOut, ...]]:
    """Separate the photos of a capture without poses into usable and odd ones.

    Args:
        photos: Files of the photos.
        name: Name of the capture, for messages.
        keep_odd: Whether copies and blurred photos stay; unreadable ones never do.
        progress: Called with photos done, photos in all and a short text.

    Raises:
        ValueError: Fewer than 8 photos are usable.
    """
    odd = find_odd_photos(photos, keep_odd=keep_odd, progress=progress)
    out = {one.name for one in odd}
    kept = [photo for photo in photos if str(photo) not in out]
    if len(kept) < MIN_VIEWS:
        found = f"{len(kept)} of {len(photos)}" if odd else f"{len(kept)}"
        first = f"; the first of the others: {odd[0].reason}" if odd else ""
        raise ValueError(
            f"{name}: expected at least {MIN_VIEWS} different photos that can be read (40 or more are usual), "
            f"found {found}{first}"
        )
    return kept, odd


def usable_masks(photos: PhotoFiles) -> tuple[PhotoFiles, tuple[LeftOut, ...]]:
    """Remove masks that are unreadable, of another shape, or uniform; return the photos and the removed masks."""

    def reason_against(photo: Path, mask: Path) -> str:
        check_mask(mask, stored_size(photo))
        return _emptiness(mask)

    masks, left_out = _without_useless(photos.paths, photos.masks, [p.name for p in photos.paths], reason_against)
    return replace(photos, masks=masks), left_out


def usable_views(posed: PosedImages, *, keep_odd: bool = False, progress: Progress = silent) -> PosedImages:
    """Remove odd photos and uniform masks from posed views, and add them to `left_out`.

    With `keep_odd`, copies and blurred photos stay; unreadable ones never do.
    """
    kept = _without(posed, find_odd_photos(posed.image_paths, keep_odd=keep_odd, progress=progress))
    names = kept.cameras.names
    masks, empty = _without_useless(kept.image_paths, kept.mask_paths, names, lambda _, mask: _emptiness(mask))
    return replace(kept, mask_paths=masks, left_out=(*kept.left_out, *empty))


def readable_views(posed: PosedImages, *, progress: Progress = silent) -> PosedImages:
    """Remove views whose files cannot be decoded to their end, and add them to `left_out`."""
    return _without(posed, find_odd_photos(posed.image_paths, keep_odd=True, progress=progress))


def _without(posed: PosedImages, odd: Sequence[LeftOut]) -> PosedImages:
    out = {one.name for one in odd}
    kept = posed.select(torch.tensor([str(path) not in out for path in posed.image_paths], dtype=torch.bool))
    return replace(kept, left_out=(*posed.left_out, *odd))


def _without_useless(
    photos: Sequence[Path],
    masks: Sequence[Path | None],
    names: Sequence[str],
    reason_against: Callable[[Path, Path], str],
) -> tuple[tuple[Path | None, ...], tuple[LeftOut, ...]]:
    """Remove the masks against which `reason_against` returns or raises a reason; no masks if none is left."""
    kept, left_out = list(masks), []
    for index, (photo, mask) in enumerate(zip(photos, masks, strict=bool(masks))):
        if mask is None or mask == photo:
            continue
        try:
            reason = reason_against(photo, mask)
        except ValueError as error:
            reason = str(error)
        if reason:
            kept[index] = None
            left_out.append(LeftOut(names[index], reason, mask_only=True))
    return tuple(kept) if any(kept) else (), tuple(left_out)


def _emptiness(mask: Path) -> str:
    """Return the reason against a mask that is black or white all over; empty for other masks."""
    solid = read_mask(mask) >= 0.5
    if bool(solid.any()) and not bool(solid.all()):
        return ""
    return f"{mask}: expected white where the object is, found {'white' if bool(solid.any()) else 'black'} all over"


def find_odd_photos(
    photos: Sequence[Path], *, keep_odd: bool = False, progress: Progress = silent
) -> tuple[LeftOut, ...]:
    """Find the photos to leave out, by full path in their order, each with a reason.

    The first of several copies is not odd. With `keep_odd`, only photos that cannot be decoded to their end or are too
    small are odd.
    """
    examined: list[_Photo] = []
    reasons: dict[Path, str] = {}
    measured_px = min(_MEASURED_PX, _median_side(photos))
    for index, photo in enumerate(photos):
        try:
            examined.append(_examine(photo, measured_px))
        except ValueError as error:
            reasons[photo] = str(error)
        progress(index + 1, len(photos), "checking photos")
    if not keep_odd:
        different, copies = _copies(examined)
        reasons |= copies | _blurred(different)
    return tuple(LeftOut(str(photo), reasons[photo]) for photo in photos if photo in reasons)


def _median_side(photos: Sequence[Path]) -> int:
    """Compute the median longest side of the photos with a readable header, pixels."""
    sides: list[int] = []
    for photo in photos:
        with suppress(ValueError):
            sides.append(max(stored_size(photo)))
    return int(np.median(sides)) if sides else 1


def _examine(path: Path, measured_px: int) -> _Photo:
    with opened(path) as image:
        size = image.size
        shrink_on_decoding(image, measured_px)
        grey = np.array(ImageOps.exif_transpose(image).convert("L"), dtype=np.float32)
    if min(size) < _MIN_SIDE_PX:
        raise ValueError(f"{path}: expected sides of at least {_MIN_SIDE_PX} px, found {size[0]}x{size[1]}")
    factor = measured_px / max(grey.shape)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    thumbnail = cv2.resize(grey, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    return _Photo(path, log_sharpness(grey), thumbnail)


def log_sharpness(grey: Float[np.ndarray, "h w"]) -> float:
    """Compute the sharpness of a photo, octaves: log2 of the RMS ratio of fine to coarse second differences.

    Args:
        grey: Grey levels from 0 to 255, float32.

    Returns:
        Sharpness in the least sharp of four directions; nan if the photo is too small or plain.
    """
    coarse = grey
    for _ in range(_COARSE_HALVINGS):
        coarse = cv2.pyrDown(coarse)
    if min(coarse.shape) < _COARSE_PX:
        return float("nan")
    fine_squares, coarse_squares = _second_differences(grey), _second_differences(coarse)
    # a tenth of a grey level is below rounding
    if coarse_squares.min() < 0.01:
        return float("nan")
    return 0.5 * float(np.log2((fine_squares + 1e-6) / coarse_squares).min())


def _second_differences(grey: np.ndarray) -> np.ndarray:
    """Compute mean squares of second differences along both axes and both diagonals, per pixel of length."""
    middle = grey[1:-1, 1:-1]
    across = (
        grey[1:-1, 2:] + grey[1:-1, :-2],
        grey[2:, 1:-1] + grey[:-2, 1:-1],
        grey[2:, 2:] + grey[:-2, :-2],
        grey[2:, :-2] + grey[:-2, 2:],
    )
    lengths = np.array([1.0, 1.0, 2.0, 2.0])
    return np.array([float(np.mean((both - 2 * middle) ** 2)) for both in across]) / lengths**2


def _copies(photos: Sequence[_Photo]) -> tuple[list[_Photo], dict[Path, str]]:
    """Return the photos without copies, and the reason against each copy."""
    kept: list[_Photo] = []
    reasons: dict[Path, str] = {}
    for photo in photos:
        first = next((p for p in kept if np.abs(p.thumbnail - photo.thumbnail).max() <= _COPY_LEVELS), None)
        if first is None:
            kept.append(photo)
        else:
            reasons[photo.path] = f"{photo.path}: expected another picture than {first.path.name}, found a copy of it"
    return kept, reasons


def _blurred(photos: Sequence[_Photo]) -> dict[Path, str]:
    """Return the reason against each blurred photo."""
    known = np.array([photo.sharpness for photo in photos if np.isfinite(photo.sharpness)])
    if not len(known):
        return {}
    middle = float(np.median(known))
    spread = 1.4826 * float(np.median(np.abs(known - middle)))
    limit = middle - max(_BLUR_OCTAVES, _BLUR_DEVIATIONS * spread)
    return {
        photo.path: f"{photo.path}: expected about as much fine detail as in the other photos, "
        f"found {2 ** (photo.sharpness - middle):.0%} of the median: it is blurred"
        for photo in photos
        if photo.sharpness < limit
    }


def require_coverage(capture: PosedImages, name: str) -> None:
    """Raise a ValueError if the views of the capture `name` are too few or too close together."""
    needed = (
        f"expected at least {MIN_VIEWS} posed views with a parallax of {_MIN_PARALLAX_DEG:g} degrees or more "
        f"(40 or more views from all around are usual)"
    )
    if len(capture) < MIN_VIEWS:
        raise ValueError(f"{name}: {needed}, found {len(capture)}")
    parallax = median_parallax_deg(capture.cameras, capture.points)
    if parallax is not None and parallax < _MIN_PARALLAX_DEG:
        raise ValueError(
            f"{name}: {needed}, found {len(capture)} views with {parallax:.2g} degrees: "
            "the cameras stand in one place, or their positions are missing"
        )


def median_parallax_deg(cameras: Cameras, points: Float[Tensor, "m 3"]) -> float | None:
    """Compute the median, over points, of the widest angle between two cameras that see the point, degrees.

    If no point is seen by two cameras, the focus point of the cameras replaces the points.

    Returns:
        The angle; 0 if all cameras are in one place, None if the cameras have no focus point either.
    """
    some = cameras.spread(_CAMERAS)
    centers = some.centers.double()
    extent = float((centers - centers.mean(0)).norm(dim=1).max())
    if extent <= 1e-6 * max(1.0, float(centers.abs().max())):
        return 0.0
    chosen = points[torch.linspace(0, len(points) - 1, min(_POINTS, len(points))).long()].double()
    seen = _seen(some, chosen)
    several = seen.sum(0) >= 2
    if bool(several.any()):
        return float(_widest_deg(centers, chosen[several], seen[:, several]).median())
    try:
        focus = focus_point(some).double()[None]
    except ValueError:
        return None
    return float(_widest_deg(centers, focus, torch.ones(len(some), 1, dtype=torch.bool))[0])


def past_subject(cameras: Cameras) -> Bool[Tensor, "v"]:
    """Find the cameras that do not show the focus point, if most cameras show it; otherwise find none."""
    try:
        seen = _seen(cameras, focus_point(cameras).double()[None])[:, 0]
    except ValueError:
        return torch.zeros(len(cameras), dtype=torch.bool)
    return ~seen & bool(seen.double().mean() >= _SUBJECT_SHARE)


def _seen(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Tensor:
    """Test which camera has which point in its image, (v, m)."""
    seen = []
    for camera in cameras:
        pixels, depth = camera.project(points)
        seen.append((depth > 0) & (pixels >= 0).all(-1) & (pixels < camera.sizes[0].double()).all(-1))
    return torch.stack(seen)


def _widest_deg(centers: Float[Tensor, "v 3"], points: Float[Tensor, "m 3"], seen: Tensor) -> Float[Tensor, "m"]:
    """Compute the widest angle at each point between two cameras that see it, degrees."""
    rays = torch.nn.functional.normalize(centers[:, None] - points, dim=-1)
    cosines = torch.einsum("vmi,wmi->mvw", rays, rays)
    both = seen.T[:, :, None] & seen.T[:, None, :]
    least = torch.where(both, cosines, torch.ones_like(cosines)).flatten(1).min(1).values
    return torch.rad2deg(torch.acos(least.clamp(-1, 1)))
