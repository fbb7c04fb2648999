"""Captures: where the poses of one lie, and their reading."""

from pathlib import Path

from splatgraft.formats.captures.colmap import is_colmap, read_colmap
from splatgraft.formats.captures.transforms_json import read_json
from splatgraft.formats.captures.views import CaptureFile


def find_poses(path: Path) -> Path | None:
    """The JSON file with the poses of a capture (a folder or that file), or its COLMAP folder; None without poses."""
    if path.suffix.lower() == ".json":
        return path
    for name in ("transforms.json", "transforms_train.json"):
        if (path / name).is_file():
            return path / name
    return path if is_colmap(path) else None


def read_capture_file(path: Path) -> CaptureFile:
    """The capture in a folder, or that a file describes; of a folder with both, transforms.json and not COLMAP's."""
    if not path.exists():
        raise ValueError(f"{path}: expected a capture folder or a transforms.json, found nothing there")
    found = path if path.is_file() else find_poses(path)
    if found is None:
        raise ValueError(
            f"{path}: expected transforms.json, or a COLMAP model in sparse/0, "
            f"found {sorted(entry.name for entry in path.iterdir())[:6]}"
        )
    return read_json(found) if found.is_file() else read_colmap(found)
