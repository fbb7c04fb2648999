"""Reads files of the data set SynCom (ComGS, Gao et al. 2026): a capture's cameras.json, objects' transform.json.

    cameras.json     {"cameras": {KEY: {"name": VIEW, "width": 800, "height": 800, "intr": [fx, fy], "extr": [16]}}}
    transform.json   {OBJECT: {"transform": [16]}}, or rotation (radians), location and scale, as Blender has them

`extr` is the pose world_from_camera, row by row, in Blender's axes; the principal point is the centre. Pictures are
images/VIEW.png beside cameras.json; alpha, where there is some, is the object's mask. The keys are those that the
loader in ComGS' public repository reads (scene/dataset_readers.py, utils/comp_utils.py).
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import IMAGE_SUFFIXES
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.formats.captures.views import (
    ViewRecord,
    cameras_of,
    existing_file,
    posed_images_of,
    rigid,
    view_or_reason,
)
from splatgraft.formats.json_file import array, excerpt, load, text, whole_side

CAMERAS_FILE = "cameras.json"
_OPENCV_FROM_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])
_MATRIX = ((4, 4), (16,))
_UNIFORM = 1e-3
"""Largest relative difference between the axes of a transform; allows numbers printed with six digits."""


def is_syncom_capture(folder: Path) -> bool:
    """Whether `folder` has a cameras.json that is a JSON object; that of the original 3DGS code is a list."""
    path = folder / CAMERAS_FILE
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(64).lstrip().startswith(b"{")


def read_capture(folder: Path) -> PosedImages:
    """The pictures of a capture with their cameras and masks.

    Its points3d.ply is not read: the points of objects are random ones, to start 3DGS from, and on no surface.

    Raises: ValueError where cameras.json is broken, or fewer than half of its pictures are usable.
    """
    path = folder / CAMERAS_FILE
    views = [view_or_reason(key, partial(_view, path, key, entry)) for key, entry in _entries(path).items()]
    none = torch.zeros(0, 3)
    return posed_images_of(views, path, folder=folder, points=none, colors=none)


def read_cameras(folder: Path) -> Cameras:
    """The cameras of a capture, whose pictures need not exist.

    Raises: ValueError where cameras.json is broken.
    """
    path = folder / CAMERAS_FILE
    return cameras_of([_view(path, key, entry, pictures=False) for key, entry in _entries(path).items()], path)[0]


def read_transform(path: Path, name: str) -> Similarity:
    """Where the object `name` stands in the scene, from the frame of the object's capture.

    Raises: ValueError where the file is broken, has no such object, or its transform is no similarity.
    """
    content = load(path)
    if not isinstance(content, dict) or not isinstance(content.get(name), dict):
        found = ", ".join(map(str, content)) if isinstance(content, dict) else excerpt(content)
        raise ValueError(f"{path}: expected a transform of the object {excerpt(name)}, found {found or 'none'}")
    entry: dict[str, Any] = content[name]
    key = next((key for key in ("transform", "transformation") if entry.get(key) is not None), None)
    matrix = _euler(path, entry) if key is None else array(path, entry, key, _MATRIX).reshape(4, 4)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    scale = float(lengths.mean())
    if not np.isfinite(matrix).all() or scale <= 0 or float(np.abs(lengths / scale - 1).max()) > _UNIFORM:
        raise ValueError(f"{path}: expected one scale above 0 for {excerpt(name)}, found {lengths.tolist()}")
    pose = matrix.copy()
    pose[:3, :3] /= scale
    pose = rigid(pose, f"{path}: {excerpt(name)}")
    return Similarity(scale, torch.tensor(pose[:3, :3]).float(), torch.tensor(pose[:3, 3]).float())


def _euler(path: Path, entry: dict[str, Any]) -> np.ndarray:
    """Rotation about the fixed axes x, y, z in turn, as Blender's XYZ order is, after the scale."""
    order = entry.get("rotation_type", "XYZ")
    if order != "XYZ":
        raise ValueError(f"{path}: expected rotation_type 'XYZ', found {excerpt(order)}")
    given = {"rotation": [0.0] * 3, "location": [0.0] * 3, "scale": [1.0] * 3, **entry}
    angles, scale = array(path, given, "rotation", ((3,),)), array(path, given, "scale", ((3,),))
    rotation = np.eye(3)
    for axis, angle in enumerate(angles):
        rotation = _turn_about(axis, angle) @ rotation
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * scale
    matrix[:3, 3] = array(path, given, "location", ((3,),))
    return matrix


def _entries(path: Path) -> dict[str, Any]:
    content = load(path)
    entries = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ValueError(f"{path}: expected an object 'cameras' with one entry a view, found {excerpt(entries)}")
    return entries


def _view(path: Path, key: str, entry: object, *, pictures: bool = True) -> ViewRecord:
    if not isinstance(entry, dict):
        raise ValueError(f"{path}: expected camera {excerpt(key)} to be an object, found {type(entry).__name__}")
    name = text(path, entry, "name")
    width, height = whole_side(path, entry, "width"), whole_side(path, entry, "height")
    # only the first two are read by the data set's own loader
    given = entry.get("intr")
    focal = array(path, {"intr": given[:2] if isinstance(given, list) else given}, "intr", ((2,),))
    pose = array(path, entry, "extr", _MATRIX).reshape(4, 4) @ _OPENCV_FROM_BLENDER
    return ViewRecord(
        name=name,
        image_path=_picture(path.parent / "images", name) if pictures else None,
        world_from_camera=rigid(pose, f"{path}: camera {excerpt(key)}"),
        focal=(float(focal[0]), float(focal[1])),
        center=(width / 2, height / 2),
        size=(width, height),
    )


def _picture(folder: Path, name: str) -> Path:
    candidates = (existing_file(folder / f"{name}{suffix}") for suffix in sorted(IMAGE_SUFFIXES))
    found = next((path for path in candidates if path is not None), None)
    if found is None:
        linear = ", only the linear .exr, which is not read" if (folder / f"{name}.exr").is_file() else ""
        raise ValueError(f"{folder / name}.png: expected an 8-bit picture, found none{linear}")
    return found


def _turn_about(axis: int, radians: float) -> np.ndarray:
    """The rotation (3, 3) by an angle, counterclockwise about a positive axis, x, y or z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = np.cos(radians)
    turn[j, i], turn[i, j] = np.sin(radians), -np.sin(radians)
    return turn
