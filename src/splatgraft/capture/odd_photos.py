"""Finds photos that do not belong among the others: unreadable, tiny, copies of another, or far more blurred.

Blur is measured by the fine detail of a photo in relation to its coarse detail, which depends little on what is shown:
mean square second differences at full size over those at a sixteenth of it, in the direction where this is least, since
a moving camera blurs in one direction only.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import ImageOps

from splatgraft.core.images import opened, shrink_on_decoding, stored_size
from splatgraft.core.posed_images import LeftOut
from splatgraft.runtime.progress import Progress, silent

_THUMBNAIL_PX = 64
_COARSE_HALVINGS = 4
"""A blur that is wide enough to take coarse detail as well must not pass for sharp: a sixteenth holds up to 16 px."""
_COARSE_PX = 8
"""Least side at that size for its detail to mean anything."""
_SAMPLES = 8
"""Photos that are looked at to tell drawings from photographs, evenly spaced."""
_EVEN_SHARE = 0.8
"""Share of neighbours of exactly one colour, above which a picture is no photograph: 0.01 to 0.4 in three photographed
captures, up to 0.53 in a rendered one, 0.98 in screenshots."""


@dataclass(frozen=True)
class OddPhotoRule:
    """When a photo counts as odd."""

    smallest_px: int = 16
    """Shorter side; smaller pictures hold no window of SSIM (11 px) and no features."""
    measured_px: int = 800
    """Longest side at which blur is measured, or the median photo's where that is smaller, so that a photo which is
    larger than the others counts by what is left of it when it is as small."""
    blur_octaves: float = 1.5
    """Fine detail below the median, as a power of two. In four captures (three photographed, one rendered) the softest
    photo lies 0.4 to 0.8 below; 9 px of motion blur or a Gaussian blur of 2 px take off 1.5 to 3, mostly 2.4."""
    blur_deviations: float = 4.0
    """And this many robust standard deviations (1.4826 median absolute deviations) below it."""
    copy_levels: float = 4.0
    """Largest difference between two thumbnails of 64 x 64 pixels that are of one picture, grey levels of 255: that of
    a JPEG saved again; another viewpoint moves edges by much more."""


@dataclass(frozen=True)
class _Photo:
    path: Path
    log_detail: float
    thumbnail: np.ndarray
    """Grey levels, float32."""


def find_odd_photos(
    photos: Sequence[Path], *, rule: OddPhotoRule = OddPhotoRule(), progress: Progress = silent
) -> tuple[LeftOut, ...]:
    """The photos to leave out, each with the reason; the first of several copies stays.

    Args:
        photos: Image files, which are each decoded once.
        rule: What counts as odd.
        progress: Moves a bar.

    Returns:
        Odd photos by full path, in the order of `photos`.
    """
    examined, reasons = _examined(photos, rule, progress)
    for photo, first in _copies(examined, rule):
        reasons[photo.path] = f"{photo.path}: expected another picture than {first.path.name}, found a copy of it"
    different = [photo for photo in examined if photo.path not in reasons]
    for photo, share in _blurred(different, rule):
        reasons[photo.path] = (
            f"{photo.path}: expected about as much fine detail as in the other photos, "
            f"found {share:.0%} of the median: it is blurred"
        )
    return tuple(LeftOut(str(photo), reasons[photo]) for photo in photos if photo in reasons)


def find_unreadable_photos(
    photos: Sequence[Path], *, rule: OddPhotoRule = OddPhotoRule(), progress: Progress = silent
) -> tuple[LeftOut, ...]:
    """The photos that cannot be decoded to their end, or are too small; arguments and result as `find_odd_photos`."""
    _, reasons = _examined(photos, rule, progress)
    return tuple(LeftOut(str(photo), reason) for photo, reason in reasons.items())


def drawn_pictures(photos: Sequence[Path]) -> str | None:
    """One sentence where the pictures look like screenshots or drawings, from which no poses follow; else None.

    Args:
        photos: Readable image files, of which some are decoded.
    """
    chosen = [photos[int(i)] for i in np.linspace(0, len(photos) - 1, min(_SAMPLES, len(photos)))]
    shares = [_even_share(photo) for photo in chosen]
    middle = float(np.median(shares)) if shares else 0.0
    if middle < _EVEN_SHARE:
        return None
    return (
        f"{photos[0].parent}: expected photographs, found pictures that are even over {middle:.0%} of their area, as "
        "screenshots and drawings are; poses and surfaces are found from texture"
    )


def _even_share(path: Path) -> float:
    with opened(path) as image:
        pixels = np.array(image.convert("RGB"))
    return float((pixels[:, 1:] == pixels[:, :-1]).all(-1).mean()) if pixels.shape[1] > 1 else 1.0


def _examined(photos: Sequence[Path], rule: OddPhotoRule, progress: Progress) -> tuple[list[_Photo], dict[Path, str]]:
    """What is known of each photo, and for others why nothing is."""
    examined: list[_Photo] = []
    reasons: dict[Path, str] = {}
    measured_px = min(rule.measured_px, _median_side(photos))
    for index, photo in enumerate(photos):
        try:
            examined.append(_examine(photo, rule.smallest_px, measured_px))
        except ValueError as error:
            reasons[photo] = str(error)
        progress(index + 1, len(photos), "checking photos")
    return examined, reasons


def _median_side(photos: Sequence[Path]) -> int:
    """Median longest side of the photos whose header can be read, pixels."""
    sides: list[int] = []
    for photo in photos:
        with suppress(ValueError):
            sides.append(max(stored_size(photo)))
    return int(np.median(sides)) if sides else 1


def _examine(path: Path, smallest_px: int, measured_px: int) -> _Photo:
    with opened(path) as image:
        size = image.size
        shrink_on_decoding(image, measured_px)
        upright = ImageOps.exif_transpose(image)
        grey = np.array(upright.convert("L"), dtype=np.float32)
    if min(size) < smallest_px:
        raise ValueError(f"{path}: expected sides of at least {smallest_px} px, found {size[0]}x{size[1]}")
    factor = measured_px / max(grey.shape)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    thumbnail = cv2.resize(grey, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    return _Photo(path, _log_detail(grey), thumbnail)


def _log_detail(grey: np.ndarray) -> float:
    """Half the binary logarithm of fine over coarse mean square second differences; nan where these are too few."""
    coarse = grey
    for _ in range(_COARSE_HALVINGS):
        coarse = cv2.pyrDown(coarse)
    if min(coarse.shape) < _COARSE_PX:
        return float("nan")
    fine_squares, coarse_squares = _second_differences(grey), _second_differences(coarse)
    # a tenth of a grey level is less than rounding: nothing to compare
    if coarse_squares.min() < 0.01:
        return float("nan")
    return 0.5 * float(np.log2((fine_squares + 1e-6) / coarse_squares).min())


def _second_differences(grey: np.ndarray) -> np.ndarray:
    """Mean squares along both axes and both diagonals, per pixel of length."""
    middle = grey[1:-1, 1:-1]
    across = (
        grey[1:-1, 2:] + grey[1:-1, :-2],
        grey[2:, 1:-1] + grey[:-2, 1:-1],
        (grey[2:, 2:] + grey[:-2, :-2]),
        (grey[2:, :-2] + grey[:-2, 2:]),
    )
    lengths = np.array([1.0, 1.0, 2.0, 2.0])
    return np.array([float(np.mean((both - 2 * middle) ** 2)) for both in across]) / lengths**2


def _copies(photos: Sequence[_Photo], rule: OddPhotoRule) -> Iterator[tuple[_Photo, _Photo]]:
    """Each copy with the photo that it repeats."""
    kept: list[_Photo] = []
    means: list[float] = []
    for photo in photos:
        mean = float(photo.thumbnail.mean())
        near = [other for other, level in zip(kept, means, strict=True) if abs(level - mean) <= rule.copy_levels]
        first = next((p for p in near if np.abs(p.thumbnail - photo.thumbnail).max() <= rule.copy_levels), None)
        if first is None:
            kept.append(photo)
            means.append(mean)
        else:
            yield photo, first


def _blurred(photos: Sequence[_Photo], rule: OddPhotoRule) -> Iterator[tuple[_Photo, float]]:
    """Each blurred photo, with its fine detail as a share of the median."""
    details = np.array([photo.log_detail for photo in photos])
    known = details[np.isfinite(details)]
    if not len(known):
        return
    middle = float(np.median(known))
    spread = 1.4826 * float(np.median(np.abs(known - middle)))
    limit = middle - max(rule.blur_octaves, rule.blur_deviations * spread)
    for photo, detail in zip(photos, details, strict=True):
        if detail < limit:
            yield photo, float(2 ** (detail - middle))
