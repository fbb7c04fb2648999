"""Photographs of a folder and their object masks: in masks/ or mask/, as NAME_mask beside the photo, or in its alpha
channel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatgraft.core.images import IMAGE_SUFFIXES, has_transparency, list_images, read_alpha, same_shape, stored_size

PHOTO_FOLDERS = ("images", "photos", "input", "rgb")
"""Folders of photos in a capture, as in COLMAP and nerfstudio, 3DGS's convert.py, and RGB-D scanners."""
_MASK_FOLDERS = ("masks", "mask")
_MASK_ENDINGS = ("_mask", ".mask")
"""Ending of a mask's stem beside its photo: defaults of Metashape and of RealityCapture."""


@dataclass(frozen=True)
class PhotoFiles:
    """Photos without poses, and the mask of each."""

    paths: tuple[Path, ...]
    """Photos, sorted by name."""
    masks: tuple[Path | None, ...] = ()
    """Masks, white on the object; the photo itself if its alpha channel is the mask; empty if no photo has one."""

    def only(self, paths: Sequence[Path]) -> "PhotoFiles":
        """Select some of the photos, with their masks."""
        masks = dict(zip(self.paths, self.masks, strict=bool(self.masks)))
        return PhotoFiles(tuple(paths), tuple(masks[path] for path in paths) if masks else ())


def find_photos(folder: Path) -> PhotoFiles:
    """Find the photos of a folder and their masks.

    Photos lie in `folder` itself, in its images/, photos/, input/ or rgb/, in the DCIM/ of a camera's card, or in the
    only folder inside. Masks lie beside the photos or beside their folder. A file NAME_mask is a mask if there is a
    photo NAME.
    """
    for place in (folder, *(folder / name for name in PHOTO_FOLDERS)):
        if place.is_dir() and (paths := _photos(place)):
            roots = [folder, place, *([place.parent] if place.name in PHOTO_FOLDERS else [])]
            masks = masks_of({path: path.name for path in paths}, roots)
            return PhotoFiles(tuple(paths), tuple(masks.get(path) for path in paths) if masks else ())
    inner = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and _holds_photos(entry)]
    inner = [entry for entry in inner if entry.name == "DCIM"] or inner
    if len(inner) == 1:
        return find_photos(inner[0])
    expected = f"{folder}: expected photos, in the folder itself or in images/"
    counts = [f"{entry.name}/ ({len(photos)} photos)" for entry in inner if (photos := _photos(entry))]
    if counts:
        raise ValueError(f"{expected}, found {', '.join(counts[:6])}: name one of these")
    inside = ", ".join(sorted(entry.name for entry in folder.iterdir())[:6])
    raise ValueError(f"{expected}, found {inside or 'an empty folder'}")


def _holds_photos(folder: Path) -> bool:
    if folder.name in _MASK_FOLDERS or folder.name.startswith((".", "__MACOSX")):
        return False
    return any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.rglob("*"))


def describe_masks(images: Sequence[Path], masks: Sequence[Path | None]) -> str:
    """Describe how many of `images` have masks, and where these were found, for a message."""
    found = {image: mask for image, mask in zip(images, masks, strict=bool(masks)) if mask is not None}
    if not found:
        return "no masks"
    inner = sum(image == mask for image, mask in found.items())
    beside = sum(_is_beside(image, mask) for image, mask in found.items())
    folders = sorted({f"{m.parent.name}/" for i, m in found.items() if m != i and not _is_beside(i, m)})
    places = [*(["alpha channels"] if inner else []), *(["NAME_mask beside NAME"] if beside else []), *folders]
    return f"{len(found)} of {len(images)} photos have masks, in {', '.join(places)}"


def check_mask(mask: Path, size: tuple[int, int]) -> None:
    """Raise ValueError if a mask does not fit an image of `size` (width, height)."""
    found = stored_size(mask)
    if not same_shape(found, size):
        expected = f"{size[0]}x{size[1]} px, as its image has, or those scaled"
        raise ValueError(f"{mask}: expected {expected}, found {found[0]}x{found[1]}")


def _photos(folder: Path) -> list[Path]:
    """List the image files that are not masks of others."""
    files = list_images(folder)
    stems = {path.stem for path in files}
    return [
        path
        for path in files
        if not any(path.stem.endswith(end) and path.stem.removesuffix(end) in stems for end in _MASK_ENDINGS)
    ]


def masks_of(images: dict[Path, str], roots: Sequence[Path]) -> dict[Path, Path]:
    """Find masks by image, in the first place that has any; `images` gives their names inside the capture."""
    for folder in (root / name for root in roots for name in _MASK_FOLDERS):
        if folder.is_dir():
            files = _by_folder_and_stem(folder)
            found = {path: mask for path, name in images.items() if (mask := _mask_of(name, folder, files))}
            if not found:
                first = next(iter(images.values()), "none")
                raise ValueError(f"{folder}: expected masks named like the images ({first}), found none")
            return found
    beside = {path: mask for path in images if (mask := _mask_beside(path))}
    return beside or _alpha_masks(list(images))


def _alpha_masks(paths: list[Path]) -> dict[Path, Path]:
    """Use alpha channels as masks if one of a few samples varies; many files have alpha 1 everywhere.

    An unreadable photo has no mask here; later checks decide whether the capture is usable without it.
    """

    def holds(test: Callable[[Path], bool], path: Path) -> bool:
        try:
            return test(path)
        except ValueError:
            return False

    transparent = [path for path in paths if holds(has_transparency, path)]
    sample = transparent[:: max(1, len(transparent) // 8)]
    varies = any(holds(lambda one: bool((read_alpha(one) < 1).any()), path) for path in sample)
    return {path: path for path in transparent} if varies else {}


def _mask_beside(image: Path) -> Path | None:
    names = (f"{image.stem}{end}{suffix}" for end in _MASK_ENDINGS for suffix in sorted(IMAGE_SUFFIXES))
    return next((path for name in names if (path := image.with_name(name)).is_file()), None)


def _is_beside(image: Path, mask: Path) -> bool:
    return any(mask.stem == image.stem + end for end in _MASK_ENDINGS) and image.parent == mask.parent


def _mask_of(image: str, masks: Path, files: dict[tuple[Path, str], list[Path]]) -> Path | None:
    name = Path(image)
    inner = Path(*name.parts[1:]) if name.parts[0] == "images" and len(name.parts) > 1 else name
    stems = (name.stem, name.name, *(name.stem + end for end in _MASK_ENDINGS))
    for folder in dict.fromkeys([(masks / inner).parent, masks]):
        found = [path for stem in stems for path in files.get((folder, stem), [])]
        if len(found) > 1:
            raise ValueError(f"{masks}: expected one mask for {image}, found {[p.name for p in found[:4]]}")
        if found:
            return found[0]
    return None


def _by_folder_and_stem(masks: Path) -> dict[tuple[Path, str], list[Path]]:
    files: dict[tuple[Path, str], list[Path]] = {}
    for folder in (masks, *(path for path in sorted(masks.rglob("*")) if path.is_dir())):
        for path in list_images(folder):
            files.setdefault((folder, path.stem), []).append(path)
    return files
