"""Finds the object mask of each photograph: by stem in a folder masks/, or in the photograph's alpha channel."""

from dataclasses import replace
from pathlib import Path

from splatgraft.core.images import has_transparency, list_images, read_alpha, same_shape, stored_size
from splatgraft.core.posed_images import LeftOut
from splatgraft.formats.captures.view_record import ViewRecord

_ALPHA_SAMPLES = 8
"""Number of files decoded to decide whether alpha channels are masks."""


def with_masks(views: list[ViewRecord], folder: Path) -> tuple[list[ViewRecord], list[LeftOut]]:
    """The views with the masks in `folder`/masks, or, without that folder, with varying alpha channels as masks.

    0001.jpg finds 0001.png and 0001.jpg.png; cam/0001.jpg finds cam/0001.png. A mask that the view already has stays. A
    mask that is missing, unreadable or of another shape is left out, with the reason.

    Raises: ValueError where masks/ has no mask for any view, or two for one.
    """
    masks = folder / "masks"
    if not any(view.mask_path for view in views):
        if masks.is_dir():
            files = _by_folder_and_stem(masks)
            views = [replace(view, mask_path=_mask_of(view, masks, files)) for view in views]
            if not any(view.mask_path for view in views):
                raise ValueError(f"{masks}: expected masks named like the images ({views[0].name}), found none")
        else:
            views = _with_alpha_masks(views)
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


def check_mask(mask: Path, size: tuple[int, int]) -> None:
    """Raise where a mask cannot be of an image with `size` (width, height).

    Raises: ValueError where it has another shape or is no readable image.
    """
    found = stored_size(mask)
    if not same_shape(found, size):
        expected = f"{size[0]}x{size[1]} px, as its image has, or those scaled"
        raise ValueError(f"{mask}: expected {expected}, found {found[0]}x{found[1]}")


def _with_alpha_masks(views: list[ViewRecord]) -> list[ViewRecord]:
    """Alpha channels are masks where one of a few samples varies; many files have alpha 1 everywhere."""
    transparent = [v.image_path is not None and has_transparency(v.image_path) for v in views]
    paths = [v.image_path for v, t in zip(views, transparent, strict=True) if t and v.image_path]
    sample = paths[:: max(1, len(paths) // _ALPHA_SAMPLES)]
    if not any(bool((read_alpha(path) < 1).any()) for path in sample):
        return views
    return [replace(v, mask_path=v.image_path) if t else v for t, v in zip(transparent, views, strict=True)]


def _mask_of(view: ViewRecord, masks: Path, files: dict[tuple[Path, str], list[Path]]) -> Path | None:
    name = Path(view.name)
    inner = Path(*name.parts[1:]) if name.parts[0] == "images" and len(name.parts) > 1 else name
    for folder in dict.fromkeys([(masks / inner).parent, masks]):
        found = [path for stem in (name.stem, name.name) for path in files.get((folder, stem), [])]
        if len(found) > 1:
            raise ValueError(f"{masks}: expected one mask for {view.name}, found {[p.name for p in found[:4]]}")
        if found:
            return found[0]
    return None


def _by_folder_and_stem(masks: Path) -> dict[tuple[Path, str], list[Path]]:
    files: dict[tuple[Path, str], list[Path]] = {}
    for folder in (masks, *(path for path in sorted(masks.rglob("*")) if path.is_dir())):
        for path in list_images(folder):
            files.setdefault((folder, path.stem), []).append(path)
    return files
