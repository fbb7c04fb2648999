"""Which files a capture is made of, for telling whether it changed. Knows nothing about what is done with them."""

from pathlib import Path

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.colmap import is_colmap


def has_poses(path: Path) -> bool:
    """Whether `path` describes cameras, rather than being photos or a video."""
    names = ("transforms.json", "transforms_train.json")
    return path.suffix == ".json" or any((path / name).is_file() for name in names) or is_colmap(path)


def description_files(path: Path) -> tuple[Path, ...]:
    """The files that hold poses and points: everything in the folder but its images and what is hidden.

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
