"""Uploaded files: stored in the project under a sanitised name after a trial read."""

import re
from pathlib import Path

from splatgraft.formats import SCENE_SUFFIXES, read_gaussians
from splatgraft.runtime.atomic_file import atomic_write

UPLOADS_FOLDER = "uploads"
SCENES = SCENE_SUFFIXES
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
SUFFIXES = (*SCENES, *VIDEOS)
LIMIT_BYTES = 1 << 30
"""Largest accepted upload."""


def save_upload(folder: Path, name: str, content: bytes, *, suffixes: tuple[str, ...]) -> Path:
    """Store a file as uploads/NAME; it replaces an earlier one of that name.

    Raises:
        ValueError: If its suffix is not in `suffixes`, or a scene cannot be read.
    """
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(name.replace("\\", "/")).name).lstrip(".") or "upload"
    path = folder / UPLOADS_FOLDER / plain
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{plain}: expected a file that ends in {', '.join(suffixes)}, found '{path.suffix}'")
    path.parent.mkdir(parents=True, exist_ok=True)
    trial = path.with_name(f".trial{path.suffix.lower()}")
    with atomic_write(trial) as stream:
        stream.write(content)
    try:
        if path.suffix.lower() in SCENES:
            read_gaussians(trial)
        trial.replace(path)
    except ValueError as error:
        raise ValueError(str(error).replace(str(trial), plain)) from None
    finally:
        trial.unlink(missing_ok=True)
    return path
