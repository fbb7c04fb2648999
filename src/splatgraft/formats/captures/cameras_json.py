"""Reads cameras.json, which the original 3DGS code writes beside a scene."""

from pathlib import Path

import numpy as np

from splatgraft.core.cameras import Cameras
from splatgraft.formats.captures.assembly import cameras_of
from splatgraft.formats.captures.view_record import ViewRecord, rigid
from splatgraft.formats.json_file import array, load, number, text, whole_side


def is_cameras_json(path: Path) -> bool:
    """Whether the file is a JSON list, as cameras.json is, and not an object."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(64).lstrip().startswith(b"[")


def read_cameras(path: Path) -> Cameras:
    """Its cameras, OpenCV axes, principal points at the centre (the file has none).

    Raises: ValueError where the file is broken.
    """
    entries = load(path)
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path}: expected a list of cameras, found {type(entries).__name__} of none")
    return cameras_of([_view(path, index, entry) for index, entry in enumerate(entries)], path)[0]


def _view(path: Path, index: int, entry: object) -> ViewRecord:
    if not isinstance(entry, dict):
        raise ValueError(f"{path}: expected camera {index} to be an object, found {type(entry).__name__}")
    width, height = whole_side(path, entry, "width"), whole_side(path, entry, "height")
    pose = np.eye(4)
    pose[:3, :3] = array(path, entry, "rotation", ((3, 3),))
    pose[:3, 3] = array(path, entry, "position", ((3,),))
    return ViewRecord(
        name=text(path, entry, "img_name"),
        image_path=None,
        world_from_camera=rigid(pose, f"{path}: camera {index}"),
        focal=(number(path, entry, "fx"), number(path, entry, "fy")),
        center=(width / 2, height / 2),
        size=(width, height),
    )
