"""COLMAP reconstructions, text and binary: cameras, images and points3D, in the folders that COLMAP uses.

If there are several models, the one with the most registered images is read.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.formats.captures.views import MAX_SIDE, CaptureFile, ViewRecord, existing_file, rigid
from splatgraft.formats.parsing import parsing

_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
)
"""Camera models by their number in binary files; those with a parameter count below are read."""
_PARAMETER_COUNTS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}
_MODEL_FOLDERS = ("sparse/*", "sparse", ".", "colmap/sparse/*", "colmap/sparse")


class _Camera(NamedTuple):
    """Fields of a `ViewRecord`."""

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    distortion: tuple[float, ...]


class _Image(NamedTuple):
    name: str
    camera_id: int
    pose: Sequence[float]
    """Quaternion wxyz and translation, camera_from_world."""


def is_colmap(folder: Path) -> bool:
    """Whether a COLMAP model lies in `folder` or in one of the sub-folders that COLMAP uses."""
    return bool(_model_folders(folder))


def _model_folders(folder: Path) -> list[Path]:
    found = [
        path
        for pattern in _MODEL_FOLDERS
        for path in (sorted(folder.glob(pattern)) if "*" in pattern else [folder / pattern])
    ]
    return [path for path in found if any((path / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))]


def _file(model: Path, stem: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (model / f"{stem}{suffix}").is_file():
            return model / f"{stem}{suffix}"
    raise ValueError(f"{model}: expected {stem}.bin or {stem}.txt, found neither")


def read_colmap(folder: Path) -> CaptureFile:
    """Read the largest model of a folder that has one, its views ordered by image name."""
    models = [(path, _read_images(_file(path, "images"))) for path in _model_folders(folder)]
    model, images = max(models, key=lambda model: len(model[1]))  # the first of equals
    source, cameras = _file(model, "images"), _read_cameras(_file(model, "cameras"))
    if not images:
        raise ValueError(f"{source}: expected registered images, found none")
    roots = [root / "images" for root in (folder, model, model.parent, model.parent.parent)]
    root = next((root for root in roots if root.is_dir()), folder)
    views = []
    for image in sorted(images, key=lambda image: image.name):
        if image.camera_id not in cameras:
            raise ValueError(f"{source}: expected camera {image.camera_id} of {image.name} in cameras, found none")
        pose, file = _pose(image, source), existing_file(root / image.name)
        views.append(ViewRecord(image.name, file, pose, **cameras[image.camera_id]._asdict()))
    return CaptureFile(source, folder, views, lambda: _read_points(_file(model, "points3D")))


def _pose(image: _Image, source: Path) -> np.ndarray:
    if not np.abs(image.pose).max() < 1e30:  # nan fails too
        raise ValueError(f"{source}: expected a pose of finite numbers for {image.name}, found nan or infinity")
    norm = float(np.linalg.norm(image.pose[:4]))
    if not 0.5 < norm < 2:
        raise ValueError(f"{source}: expected a unit quaternion for {image.name}, found length {norm:.4g}")
    quaternion = torch.tensor([image.pose[:4]], dtype=torch.float64)
    world_from_camera = rotation_from_quaternion(quaternion)[0].numpy().T
    pose = np.eye(4)
    pose[:3, :3] = world_from_camera
    pose[:3, 3] = -world_from_camera @ np.array(image.pose[4:])
    return rigid(pose, f"{source}: {image.name}")


def _camera(model: str, size: tuple[int, int], numbers: tuple[float, ...]) -> _Camera:
    if model not in _PARAMETER_COUNTS:
        raise ValueError(
            f"expected camera model {', '.join(_PARAMETER_COUNTS)}, found {model[:40]}; "
            "undistort the images with 'colmap image_undistorter' first"
        )
    if len(numbers) != _PARAMETER_COUNTS[model]:
        raise ValueError(f"expected {_PARAMETER_COUNTS[model]} numbers for {model}, found {len(numbers)}")
    if not 1 <= min(size) <= max(size) <= MAX_SIDE:
        raise ValueError(f"expected image sides from 1 to {MAX_SIDE} px, found {size[0]} and {size[1]}")
    if model in ("PINHOLE", "OPENCV"):
        focal, center, rest = numbers[:2], numbers[2:4], numbers[4:]
    else:
        focal, center, rest = (numbers[0], numbers[0]), numbers[1:3], numbers[3:]
    return _Camera(size, (focal[0], focal[1]), (center[0], center[1]), (*rest, *[0.0] * (5 - len(rest))))


def _read_cameras(path: Path) -> dict[int, _Camera]:
    cameras = {}
    with parsing(path):
        if path.suffix == ".txt":
            for line in _lines(path):
                camera_id, model, width, height, *numbers = line.split()
                cameras[int(camera_id)] = _camera(model, (int(width), int(height)), tuple(map(float, numbers)))
            return cameras
        records = _Records(path.read_bytes())
        for _ in range(records.take("<Q")[0]):
            camera_id, number, width, height = records.take("<IiQQ")
            model = _MODELS[number] if 0 <= number < len(_MODELS) else f"number {number}"
            numbers = records.take(f"<{_PARAMETER_COUNTS.get(model, 0)}d")
            cameras[camera_id] = _camera(model, (width, height), numbers)
        records.end()
        return cameras


def _read_images(path: Path) -> list[_Image]:
    images = []
    with parsing(path):
        if path.suffix == ".txt":
            lines = iter(_lines(path, every=True))
            for line in lines:
                if not line or line.startswith("#"):
                    continue
                _, qw, qx, qy, qz, tx, ty, tz, camera_id, name = line.split(None, 9)
                pose = [float(number) for number in (qw, qx, qy, qz, tx, ty, tz)]
                images.append(_Image(name, int(camera_id), pose))
                next(lines, None)  # observations, which may be none
            return images
        records = _Records(path.read_bytes())
        for _ in range(records.take("<Q")[0]):
            _, *pose, camera_id = records.take("<I7dI")
            name = records.take_name()
            records.skip(records.take("<Q")[0] * 24)  # observations
            images.append(_Image(name, camera_id, pose))
        records.end()
        return images


def _read_points(path: Path) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    found = []
    with parsing(path):
        if path.suffix == ".txt":
            for line in _lines(path):
                x, y, z, *color = line.split(None, 8)[1:7]
                red, green, blue = bytes(map(int, color))  # refuses numbers above 255
                found.append([float(x), float(y), float(z), red, green, blue])
        else:
            records = _Records(path.read_bytes())
            for _ in range(records.take("<Q")[0]):
                _, *point, _, track = records.take("<Q3d3BdQ")
                found.append(point)
                records.skip(track * 8)
            records.end()
        table = np.array(found, np.float64).reshape(-1, 6)
        positions, colors = table[:, :3], table[:, 3:].astype(np.uint8)
        if not np.isfinite(positions).all() or np.abs(positions).max(initial=0) > 1e30:
            raise ValueError("expected finite points, found nan, infinity or more than 1e30")
        return torch.from_numpy(positions).float(), torch.from_numpy(colors).float() / 255


def _lines(path: Path, *, every: bool = False) -> list[str]:
    """Read the lines of a text file, without empty ones and comments unless `every` line counts."""
    lines = [line.strip() for line in path.read_text("utf-8").splitlines()]
    return [line for line in lines if every or (line and not line.startswith("#"))]


@dataclass
class _Records:
    """A binary file that is read from front to back; its counts are not trusted."""

    data: bytes
    at: int = 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def skip(self, size: int) -> None:
        self.at += size

    def take_name(self) -> str:
        end = self.data.index(b"\0", self.at)
        name = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return name

    def end(self) -> None:
        if self.at != len(self.data):
            raise ValueError(f"expected the end after {self.at} bytes, found {len(self.data)}")
