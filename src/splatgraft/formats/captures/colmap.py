"""Reads COLMAP reconstructions, text and binary: cameras, images and points3D, in the folders that COLMAP uses.

Counts in binary files are not trusted: every record is checked against the bytes that are left.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.assembly import cameras_of, fitted_to_file, posed_images_of
from splatgraft.formats.captures.view_record import MAX_SIDE, ViewRecord, existing_file, rigid

_MODELS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV"}
_PARAMETER_COUNTS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}
_OTHER_MODELS = {
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}
_MODEL_FOLDERS = ("sparse/*", "sparse", ".", "colmap/sparse/*", "colmap/sparse")


@dataclass(frozen=True)
class _Camera:
    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    distortion: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    name: str
    camera_id: int
    quaternion: tuple[float, ...]
    """wxyz, camera from world."""
    translation: tuple[float, ...]


def is_colmap(folder: Path) -> bool:
    """Whether a COLMAP model lies in `folder` or in one of the sub-folders that COLMAP uses."""
    return bool(_model_folders(folder))


def read_capture(folder: Path) -> PosedImages:
    """The model with the most registered images, ordered by image name.

    Raises: ValueError where no whole model is there, its camera model is not supported, or an image is missing.
    """
    model, images = _largest_model(folder)
    points, colors = _read_points(_file(model, "points3D"))
    source = _file(model, "images")
    return posed_images_of(_views(model, images, folder), source, folder=folder, points=points, colors=colors)


def read_views(folder: Path) -> tuple[list[ViewRecord], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """The photos of the largest model, whose files need not exist, its points and their colours.

    Raises: ValueError where no whole model is there, or its camera model is not supported.
    """
    model, images = _largest_model(folder)
    return _views(model, images, folder), *_read_points(_file(model, "points3D"))


def read_cameras(folder: Path) -> Cameras:
    """The cameras of the largest model; images need not exist.

    Raises: ValueError where no whole model is there, or its camera model is not supported.
    """
    model, images = _largest_model(folder)
    source = _file(model, "images")
    return cameras_of([fitted_to_file(view, source) for view in _views(model, images, folder)], source)[0]


def image_files(folder: Path) -> list[Path]:
    """The image files of the largest model that exist.

    Raises: ValueError where no whole model is there.
    """
    return [view.image_path for view in _views(*_largest_model(folder), folder) if view.image_path]


def _model_folders(folder: Path) -> list[Path]:
    found = [
        path
        for pattern in _MODEL_FOLDERS
        for path in (sorted(folder.glob(pattern)) if "*" in pattern else [folder / pattern])
    ]
    return [path for path in found if any((path / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))]


def _largest_model(folder: Path) -> tuple[Path, list[_Image]]:
    models = [(path, _read_images(_file(path, "images"))) for path in _model_folders(folder)]
    if not models:
        raise ValueError(f"{folder}: expected a COLMAP model (cameras, images, points3D as .bin or .txt), found none")
    best = max(models, key=lambda model: len(model[1]))  # the first of equals
    if not best[1]:
        raise ValueError(f"{_file(best[0], 'images')}: expected registered images, found none")
    return best


def _file(model: Path, stem: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (model / f"{stem}{suffix}").is_file():
            return model / f"{stem}{suffix}"
    raise ValueError(f"{model}: expected {stem}.bin or {stem}.txt, found neither")


def _views(model: Path, images: list[_Image], folder: Path) -> list[ViewRecord]:
    cameras = _read_cameras(_file(model, "cameras"))
    source = _file(model, "images")
    roots = [root / "images" for root in (folder, model, model.parent, model.parent.parent)]
    roots = [root for root in roots if root.is_dir()] or [folder]
    views = []
    for image in sorted(images, key=lambda image: image.name):
        camera = cameras.get(image.camera_id)
        if camera is None:
            raise ValueError(f"{source}: expected camera {image.camera_id} of {image.name} in cameras, found none")
        views.append(
            ViewRecord(
                name=image.name,
                image_path=existing_file(roots[0] / image.name),
                world_from_camera=_pose(image, source),
                focal=camera.focal,
                center=camera.center,
                size=camera.size,
                distortion=camera.distortion,
            )
        )
    return views


def _pose(image: _Image, source: Path) -> np.ndarray:
    quaternion = np.array(image.quaternion)
    if not np.abs([*image.quaternion, *image.translation]).max() < 1e30:  # nan fails too
        raise ValueError(f"{source}: expected a pose of finite numbers for {image.name}, found nan or infinity")
    norm = float(np.linalg.norm(quaternion))
    if not 0.5 < norm < 2:
        raise ValueError(f"{source}: expected a unit quaternion for {image.name}, found length {norm:.4g}")
    w, x, y, z = quaternion / norm
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ np.array(image.translation)
    return rigid(pose, f"{source}: {image.name}")


def _camera(path: Path, model: str, size: tuple[int, int], numbers: tuple[float, ...]) -> _Camera:
    if model not in _PARAMETER_COUNTS:
        raise ValueError(
            f"{path}: expected camera model {', '.join(_PARAMETER_COUNTS)}, found {model[:40]}; "
            "undistort the images with 'colmap image_undistorter' first"
        )
    if len(numbers) != _PARAMETER_COUNTS[model]:
        raise ValueError(f"{path}: expected {_PARAMETER_COUNTS[model]} numbers for {model}, found {len(numbers)}")
    if not 1 <= min(size) <= max(size) <= MAX_SIDE:
        raise ValueError(f"{path}: expected image sides from 1 to {MAX_SIDE} px, found {size[0]} and {size[1]}")
    if model in ("PINHOLE", "OPENCV"):
        focal, center, rest = numbers[:2], numbers[2:4], numbers[4:]
    else:
        focal, center, rest = (numbers[0], numbers[0]), numbers[1:3], numbers[3:]
    return _Camera(size, (focal[0], focal[1]), (center[0], center[1]), (*rest, *[0.0] * (5 - len(rest))))


def _read_cameras(path: Path) -> dict[int, _Camera]:
    if path.suffix == ".txt":
        return dict(_text_camera(path, line) for line in _lines(path) if line and not line.startswith("#"))
    records = _Records(path)
    cameras = {}
    for _ in range(records.count(24)):
        camera_id, number, width, height = records.take("<IiQQ")
        model = _MODELS.get(number) or _OTHER_MODELS.get(number, f"number {number}")
        numbers = records.take(f"<{_PARAMETER_COUNTS.get(model, 0)}d")
        cameras[camera_id] = _camera(path, model, (width, height), numbers)
    records.finish()
    return cameras


def _text_camera(path: Path, line: str) -> tuple[int, _Camera]:
    try:
        camera_id, model, width, height, *numbers = line.split()
        values = int(camera_id), (int(width), int(height)), tuple(map(float, numbers))
    except ValueError:
        raise ValueError(f"{path}: expected 'ID MODEL WIDTH HEIGHT PARAMETERS', found {line[:60]!r}") from None
    return values[0], _camera(path, model, values[1], values[2])


def _read_images(path: Path) -> list[_Image]:
    if path.suffix == ".txt":
        return list(_text_images(path))
    records = _Records(path)
    images = []
    for _ in range(records.count(73)):
        _, *pose, camera_id = records.take("<I7dI")
        name = records.take_name()
        (observations,) = records.take("<Q")
        records.skip(observations * 24)
        images.append(_Image(name, camera_id, tuple(pose[:4]), tuple(pose[4:])))
    records.finish()
    return images


def _text_images(path: Path) -> Iterator[_Image]:
    """Two lines each: the pose, and the observations, which may be empty."""
    lines = iter(_lines(path))
    for line in lines:
        if not line or line.startswith("#"):
            continue
        try:
            _, *pose, camera_id, name = line.split(None, 9)
            values = [float(number) for number in pose]
            if len(values) != 7:
                raise ValueError
            image = _Image(name, int(camera_id), tuple(values[:4]), tuple(values[4:]))
        except ValueError:
            expected = "'ID QW QX QY QZ TX TY TZ CAMERA NAME'"
            raise ValueError(f"{path}: expected {expected}, found {line[:60]!r}") from None
        next(lines, None)
        yield image


def _read_points(path: Path) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    if path.suffix == ".txt":
        positions, colors = _text_points(path)
    else:
        records = _Records(path)
        count = records.count(51)
        positions, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
        for i in range(count):
            _, x, y, z, red, green, blue, _, track = records.take("<Q3d3BdQ")
            positions[i], colors[i] = (x, y, z), (red, green, blue)
            records.skip(track * 8)
        records.finish()
    if not np.isfinite(positions).all() or np.abs(positions).max(initial=0) > 1e30:
        raise ValueError(f"{path}: expected finite points, found nan, infinity or more than 1e30")
    return torch.from_numpy(positions).float(), torch.from_numpy(colors).float() / 255


def _text_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    positions, colors = [], []
    for line in _lines(path):
        if not line or line.startswith("#"):
            continue
        words = line.split(None, 8)
        try:
            position, color = np.array(words[1:4], np.float64), np.array([int(word) for word in words[4:7]])
        except (ValueError, OverflowError):
            position = color = np.empty(0)
        if len(position) != 3 or len(color) != 3 or color.min() < 0 or color.max() > 255:
            raise ValueError(f"{path}: expected 'ID X Y Z R G B ERROR TRACK', found {line[:60]!r}")
        positions.append(position)
        colors.append(color.astype(np.uint8))
    return np.array(positions).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3)


def _lines(path: Path) -> list[str]:
    try:
        return [line.strip() for line in path.read_text("utf-8").splitlines()]
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected UTF-8 text, found {error.reason} at byte {error.start}") from None


class _Records:
    """A binary file read from front to back; every step is checked against its length."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = path.read_bytes()
        self._at = 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize(layout)
        self.skip(size)
        return struct.unpack_from(layout, self._data, self._at - size)

    def skip(self, size: int) -> None:
        if self._at + size > len(self._data):
            left = len(self._data) - self._at
            raise ValueError(f"{self._path}: expected {size} more bytes at byte {self._at}, found {left}")
        self._at += size

    def count(self, least: int) -> int:
        """The number of records that follow, each of at least `least` bytes."""
        (count,) = self.take("<Q")
        if count * least > len(self._data) - self._at:
            left = len(self._data) - self._at
            raise ValueError(f"{self._path}: expected at least {count * least} bytes for {count} records, found {left}")
        return count

    def take_name(self) -> str:
        end = self._data.find(b"\0", self._at)
        raw = self._data[self._at : end] if end >= 0 else b""
        try:
            name = raw.decode("utf-8")
        except UnicodeDecodeError:
            name = ""
        if not name:
            raise ValueError(f"{self._path}: expected an image name in UTF-8 at byte {self._at}, found {raw[:40]!r}")
        self._at = end + 1
        return name

    def finish(self) -> None:
        if self._at != len(self._data):
            left = len(self._data) - self._at
            raise ValueError(f"{self._path}: expected the end after {self._at} bytes, found {left} more")
