"""The files that a capture consists of, from which steps detect that it changed."""

from pathlib import Path

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.colmap import is_colmap


def has_poses(path: Path) -> bool:
    """Whether `path` has camera poses, and is not only photos or a video."""
    names = ("transforms.json", "transforms_train.json")
    return path.suffix == ".json" or any((path / name).is_file() for name in names) or is_colmap(path)


def description_files(path: Path) -> tuple[Path, ...]:
    """The files with poses and points: all in the folder except images, step.json and hidden files.

    Raises: ValueError where there is nothing at `path`.
    """
    if path.is_file():
        return (path,)
    if not path.is_dir():
        raise ValueError(f"{path}: expected a capture folder, found nothing")
    suffixes = {".json", ".ply", ".bin", ".txt"}
    found = [p for p in path.rglob("*") if p.is_file() and p.suffix in suffixes and p.name != "step.json"]
    return tuple(sorted(p for p in found if not any(part.startswith(".") for part in p.relative_to(path).parts)))


def capture_inputs(path: Path, capture: PosedImages, *, masks: bool = False) -> dict[str, tuple[Path, ...]]:
    """All input files of a step that reads `capture` from `path`, by role."""
    inputs = {"capture": description_files(path), "images": tuple(capture.image_paths)}
    if masks:
        inputs["masks"] = tuple(p for p in capture.mask_paths if p is not None)
    return inputs
