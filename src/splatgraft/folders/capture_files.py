"""Files of a capture, by which steps detect changes, and notes on its photos."""

from collections.abc import Sequence
from pathlib import Path

from splatgraft.core.exposure import describe_inconsistency, relative_gains
from splatgraft.core.images import list_images
from splatgraft.core.posed_images import LeftOut, PosedImages
from splatgraft.formats.captures import find_poses
from splatgraft.formats.captures.exif import read_exposure
from splatgraft.project.layout import CLOCK_SUN_FILE
from splatgraft.runtime.note import Note

_NOT_POSES = ("step.json", CLOCK_SUN_FILE)
_NAMED = 8  # maximum number of images that a message names


def has_poses(path: Path) -> bool:
    """Whether `path` has camera poses, and is not only photos or a video."""
    return find_poses(path) is not None


def description_files(path: Path) -> tuple[Path, ...]:
    """List the files with poses and points: all in the folder except images, the sun's, step.json and hidden files."""
    if path.is_file():
        return (path,)
    if not path.is_dir():
        raise ValueError(f"{path}: expected a capture folder, found nothing")
    suffixes = {".json", ".ply", ".bin", ".txt"}
    found = [p for p in path.rglob("*") if p.is_file() and p.suffix in suffixes and p.name not in _NOT_POSES]
    return tuple(sorted(p for p in found if not any(part.startswith(".") for part in p.relative_to(path).parts)))


def capture_inputs(path: Path, capture: PosedImages, *, masks: bool = False) -> dict[str, tuple[Path, ...]]:
    """List all input files of a step that reads `capture` from `path`, by role."""
    inputs = {"capture": description_files(path), "images": tuple(capture.image_paths)}
    if masks:
        inputs["masks"] = tuple(p for p in capture.mask_paths if p is not None)
    return inputs


def unposed_notes(path: Path, capture: PosedImages) -> list[Note]:
    """Warn if most of the images in the folders of the capture at `path` have no pose."""
    folders = {image.parent for image in capture.image_paths}
    total = sum(len(list_images(folder)) for folder in folders)
    if len(capture) >= 0.5 * total:
        return []
    found = f"only {len(capture)} of the {total} images in {min(folders)} have a pose"
    return [Note(f"{path}: {found}; the others are not used", "warning")]


def camera_files(path: Path) -> tuple[Path, ...]:
    """List the files that hold the cameras of `path`, a file or a folder of a capture."""
    if not path.is_dir():
        return (path,)
    found = find_poses(path)
    if found is None:
        raise ValueError(f"{path}: expected transforms.json, or a COLMAP model in sparse/0, found neither")
    if found.is_file():
        return (found,)
    return tuple(file for file in description_files(path) if file.stem in ("cameras", "images"))


def left_out_notes(path: Path, kept: int, left_out: Sequence[LeftOut]) -> list[Note]:
    """Describe the unused images of the capture at `path`: number and names, then a note per kind of reason."""
    if not left_out:
        return []
    total = kept + sum(not one.mask_only for one in left_out)
    more = f" and {len(left_out) - _NAMED} more" if len(left_out) > _NAMED else ""
    names = ", ".join(str(one) for one in left_out[:_NAMED])
    head = f"{path}: uses {kept} of {total} images, without {names}{more}"
    by_kind: dict[str, list[str]] = {}
    for one in left_out:
        by_kind.setdefault(one.reason.replace(one.name, ""), []).append(one.reason)
    lines = [
        f"left out: {reasons[0]}" + (f" (and {len(reasons) - 1} more like it)" if len(reasons) > 1 else "")
        for reasons in by_kind.values()
    ]
    # four kept photos per left-out one, or forty, leave enough; set by hand
    level = "minor" if 4 * len(left_out) <= kept or kept >= 40 else "warning"
    return [Note(head, level), *(Note(line) for line in lines[:_NAMED])]


def exposure_notes(name: Path, photos: Sequence[Path]) -> list[Note]:
    """Warn, with `name` first, if exposures of photos differ or white balance was automatic."""
    found = describe_inconsistency([read_exposure(photo) for photo in photos])
    return [] if found is None else [Note(f"{name}: {found}", "minor")]


def read_view_gains(photos: Sequence[Path]) -> list[float] | None:
    """Read the brightness of each photo over their mean, by its settings; None if the settings are constant."""
    exposures = [read_exposure(photo) for photo in photos]
    return None if describe_inconsistency(exposures) is None else relative_gains(exposures)
