"""Leaves out photos and masks of a capture that would harm what is made of it, with the reason for each."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from splatgraft.capture.odd_photos import find_odd_photos, find_unreadable_photos
from splatgraft.capture.view_coverage import CoverageRule
from splatgraft.core.images import read_mask
from splatgraft.core.posed_images import LeftOut, PosedImages
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
    empty = dict(_empty_masks(kept))
    masks = tuple(None if index in empty else path for index, path in enumerate(kept.mask_paths))
    return replace(
        kept,
        mask_paths=masks if any(masks) else (),
        left_out=(*posed.left_out, *odd, *empty.values()),
    )


def readable_views(posed: PosedImages, *, progress: Progress = silent) -> PosedImages:
    """The posed views whose files can be decoded to their end; the others are added to `left_out`."""
    odd = find_unreadable_photos(posed.image_paths, progress=progress)
    out = {one.name for one in odd}
    kept = posed.select(torch.tensor([str(path) not in out for path in posed.image_paths], dtype=torch.bool))
    return replace(kept, left_out=(*posed.left_out, *odd))


def _odd(photos: Sequence[Path], keep_odd: bool, progress: Progress) -> tuple[LeftOut, ...]:
    find = find_unreadable_photos if keep_odd else find_odd_photos
    return find(photos, progress=progress)


def _empty_masks(posed: PosedImages) -> Iterator[tuple[int, LeftOut]]:
    for index, path in enumerate(posed.mask_paths):
        if path is None or path == posed.image_paths[index]:
            continue
        name = posed.cameras.names[index]
        try:
            solid = read_mask(path) >= 0.5
        except ValueError as error:
            yield index, LeftOut(name, str(error), mask_only=True)
            continue
        if not bool(solid.any()) or bool(solid.all()):
            color = "white" if bool(solid.any()) else "black"
            reason = f"{path}: expected white where the object is, found {color} all over"
            yield index, LeftOut(name, reason, mask_only=True)
