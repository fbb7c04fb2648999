"""Leaves out photos and masks of a capture that would harm what is made of it, with the reason for each."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from splatgraft.capture.odd_photos import find_odd_photos, find_unreadable_photos
from splatgraft.capture.view_coverage import CoverageRule
from splatgraft.core.images import read_mask, stored_size
from splatgraft.core.posed_images import LeftOut, PosedImages
from splatgraft.formats.captures.masks import PhotoFiles, check_mask
from splatgraft.runtime.progress import Progress, silent

LEAST_PHOTOS = CoverageRule().views
"""Different photos that are needed, with or without poses."""


def usable_photos(
    photos: Sequence[Path], name: str, *, keep_odd: bool = False, progress: Progress = silent
) -> tuple[list[Path], tuple[LeftOut, ...]]:
    """The photos without poses that are worth a pose, and the others.

    Args:
        photos: Image files.
        name: The capture, for the message.
        keep_odd: Whether copies and blurred photos stay; unreadable ones never do.
        progress: Moves a bar.

    Raises:
        ValueError: Where fewer than 8 different photos are left.
    """
    odd = _odd(photos, keep_odd, progress)
    out = {one.name for one in odd}
    kept = [photo for photo in photos if str(photo) not in out]
    if len(kept) < LEAST_PHOTOS:
        found = f"{len(kept)} of {len(photos)}" if odd else f"{len(kept)}"
        first = f"; the first of the others: {odd[0].reason}" if odd else ""
        raise ValueError(
            f"{name}: expected at least {LEAST_PHOTOS} different photos that can be read (40 or more are usual), "
            f"found {found}{first}"
        )
    return kept, odd


def usable_masks(photos: PhotoFiles) -> tuple[PhotoFiles, tuple[LeftOut, ...]]:
    """Photos without poses, whose masks are all of use, and the masks that were left out.

    Args:
        photos: Readable photos, with masks or without.

    Returns:
        The same photos without masks that are unreadable, of another shape than their photo, or black or white all
        over; and these, with the reason for each.
    """

    def reason_against(photo: Path, mask: Path) -> str:
        check_mask(mask, stored_size(photo))
        return _emptiness(mask)

    masks, left_out = _without_useless(photos.paths, photos.masks, [p.name for p in photos.paths], reason_against)
    return replace(photos, masks=masks), left_out


def usable_views(posed: PosedImages, *, keep_odd: bool = False, progress: Progress = silent) -> PosedImages:
    """The posed views without odd photos, and without masks that are black or white all over.

    Args:
        posed: Views whose files exist.
        keep_odd: Whether copies and blurred photos stay; unreadable ones never do.
        progress: Moves a bar.

    Returns:
        The others; what was left out is added to `left_out`.
    """
    odd = _odd(posed.image_paths, keep_odd, progress)
    out = {one.name for one in odd}
    kept = posed.select(torch.tensor([str(path) not in out for path in posed.image_paths], dtype=torch.bool))
    names = kept.cameras.names
    masks, empty = _without_useless(kept.image_paths, kept.mask_paths, names, lambda _, mask: _emptiness(mask))
    return replace(kept, mask_paths=masks, left_out=(*posed.left_out, *odd, *empty))


def readable_views(posed: PosedImages, *, progress: Progress = silent) -> PosedImages:
    """The posed views whose files can be decoded to their end; the others are added to `left_out`."""
    odd = find_unreadable_photos(posed.image_paths, progress=progress)
    out = {one.name for one in odd}
    kept = posed.select(torch.tensor([str(path) not in out for path in posed.image_paths], dtype=torch.bool))
    return replace(kept, left_out=(*posed.left_out, *odd))


def _odd(photos: Sequence[Path], keep_odd: bool, progress: Progress) -> tuple[LeftOut, ...]:
    find = find_unreadable_photos if keep_odd else find_odd_photos
    return find(photos, progress=progress)


def _without_useless(
    photos: Sequence[Path],
    masks: Sequence[Path | None],
    names: Sequence[str],
    reason_against: Callable[[Path, Path], str],
) -> tuple[tuple[Path | None, ...], tuple[LeftOut, ...]]:
    """The masks that are of use, none where there are none, and the others with their reasons.

    Args:
        photos: Image files.
        masks: One each or None, or empty; the photo itself where its alpha channel is the mask.
        names: What the photos are called.
        reason_against: Why a photo's mask is not used, empty where it is; a ValueError's message is a reason too.
    """
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
    """Why a mask that is black or white all over tells nothing; empty where it is neither."""
    solid = read_mask(mask) >= 0.5
    if bool(solid.any()) and not bool(solid.all()):
        return ""
    color = "white" if bool(solid.any()) else "black"
    return f"{mask}: expected white where the object is, found {color} all over"
