"""Which mask belongs to which photograph: by stem in a folder masks/, or the photographs' own alpha channels."""

from dataclasses import replace
from pathlib import Path

from splatgraft.formats.views import View
from splatgraft.images import has_transparency, list_images, read_alpha


def with_masks(views: list[View], folder: Path) -> list[View]:
    """The views with the masks of `folder`/masks; else, where photographs have transparent parts, with their own.

    0001.jpg finds 0001.png and 0001.jpg.png; cam/0001.jpg finds cam/0001.png. A mask the view already has stays.

    Raises: ValueError where masks/ has no mask for any view, or two for one.
    """
    masks = folder / "masks"
    if any(view.mask_path for view in views):
        return views
    if masks.is_dir():
        found = [replace(view, mask_path=_mask_of(view, masks)) for view in views]
        if views and not any(view.mask_path for view in found):
            raise ValueError(f"{masks}: expected masks named like the images ({views[0].name}), found none")
        return found
    transparent = [v.image_path is not None and has_transparency(v.image_path) for v in views]
    # many files have an alpha channel that is 1 everywhere; the first that varies settles that it is meant
    if not any(t and bool((read_alpha(v.image_path) < 1).any()) for t, v in zip(transparent, views, strict=True)):
        return views
    return [replace(v, mask_path=v.image_path) if t else v for t, v in zip(transparent, views, strict=True)]


def _mask_of(view: View, masks: Path) -> Path | None:
    name = Path(view.name)
    inner = Path(*name.parts[1:]) if name.parts[0] == "images" and len(name.parts) > 1 else name
    for folder in dict.fromkeys([(masks / inner).parent, masks]):
        files = list_images(folder) if folder.is_dir() else []
        found = [p for p in files if p.stem in (name.stem, name.name)]
        if len(found) > 1:
            raise ValueError(f"{masks}: expected one mask for {view.name}, found {[p.name for p in found[:4]]}")
        if found:
            return found[0]
    return None
