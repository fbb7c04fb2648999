"""transforms.json: cameras and photographs with the keys of Blender and nerfstudio, OpenGL axes.

cameras.json, which the original 3DGS code writes beside a scene, is read as well.
"""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatgraft.core.cameras import Cameras
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import IMAGE_SUFFIXES, stored_size
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.views import CaptureFile, ViewRecord, existing_file, rigid, view_or_reason
from splatgraft.formats.json_file import array, excerpt, load, number, save, text, whole_side
from splatgraft.formats.scenes.ply import read_points, write_points
from splatgraft.runtime.files import relative_name

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
_CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


def read_json(path: Path) -> CaptureFile:
    """Read the capture of a transforms.json, or the cameras of a cameras.json, which is a list."""
    meta = load(path)
    if isinstance(meta, list):
        return _cameras_json(path, meta)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not meta["frames"]:
        raise ValueError(f"{path}: expected a JSON object with a list of 'frames', found {excerpt(meta)}")
    views = [
        view_or_reason(_frame_name(index, frame), partial(_view, path, index, meta, frame))
        for index, frame in enumerate(meta["frames"])
    ]
    if meta.get("ply_file_path") is None:
        return CaptureFile(path, path.parent, views)
    return CaptureFile(path, path.parent, views, lambda: read_points(path.parent / text(path, meta, "ply_file_path")))


def _cameras_json(path: Path, entries: list[Any]) -> CaptureFile:
    """Read cameras with OpenCV axes and without images; the file has no principal points, so they are at the centre."""
    views = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ValueError(f"{path}: expected camera {index} to be an object, found {type(entry).__name__}")
        width, height = whole_side(path, entry, "width"), whole_side(path, entry, "height")
        pose = np.eye(4)
        pose[:3, :3] = array(path, entry, "rotation", ((3, 3),))
        pose[:3, 3] = array(path, entry, "position", ((3,),))
        views.append(
            ViewRecord(
                name=text(path, entry, "img_name"),
                image_path=None,
                world_from_camera=rigid(pose, f"{path}: camera {index}"),
                focal=(number(path, entry, "fx"), number(path, entry, "fy")),
                center=(width / 2, height / 2),
                size=(width, height),
            )
        )
    if not views:
        raise ValueError(f"{path}: expected a list of cameras, found none")
    return CaptureFile(path, path.parent, views)


def _view(path: Path, index: int, meta: dict[str, Any], frame: Any) -> ViewRecord:
    if not isinstance(frame, dict):
        raise ValueError(f"{path}: expected frame {index} to be an object, found {type(frame).__name__}")
    camera = {**{k: v for k, v in meta.items() if k != "frames"}, **frame}
    model = camera.get("camera_model", "OPENCV")
    if model not in _CAMERA_MODELS or camera.get("is_fisheye") or number(path, camera, "k4", 0.0):
        fisheye = excerpt(camera.get("is_fisheye", False))
        found = f"{excerpt(model)}, k4 = {excerpt(camera.get('k4', 0))}, is_fisheye = {fisheye}"
        raise ValueError(f"{path}: expected camera_model {', '.join(_CAMERA_MODELS)} without k4, found {found}")
    name = text(path, camera, "file_path")
    image_path = _image_file(path.parent / name)
    width, height = _size(path, camera, image_path)
    fl_x = _focal(path, camera, "x", width)
    fl_y = _focal(path, camera, "y", height) or fl_x
    if fl_x is None or fl_y is None:
        raise ValueError(f"{path}: expected fl_x or camera_angle_x for frame {index}, found neither")
    return ViewRecord(
        name=name,
        image_path=image_path,
        mask_path=None if camera.get("mask_path") is None else path.parent / text(path, camera, "mask_path"),
        world_from_camera=_pose(path, index, frame),
        focal=(fl_x, fl_y),
        center=(number(path, camera, "cx", width / 2), number(path, camera, "cy", height / 2)),
        size=(width, height),
        distortion=tuple(number(path, camera, key, 0.0) for key in _COEFFICIENTS),
    )


def _frame_name(index: int, frame: Any) -> str:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    return name if isinstance(name, str) and name.isprintable() else f"frame {index}"


def _pose(path: Path, index: int, frame: dict[str, Any]) -> np.ndarray:
    matrix = array(path, frame, "transform_matrix", ((4, 4), (3, 4)))
    if len(matrix) == 3:
        matrix = np.concatenate([matrix, [[0, 0, 0, 1]]])
    return rigid(matrix, f"{path}: frame {index}") @ _OPENCV_FROM_OPENGL


def _size(path: Path, camera: dict[str, Any], image_path: Path | None) -> tuple[int, int]:
    if "w" not in camera and "h" not in camera:
        if image_path is None:
            raise ValueError(
                f"{path}: expected w and h, or the image file {excerpt(camera.get('file_path'))}, found neither"
            )
        return stored_size(image_path)
    return whole_side(path, camera, "w"), whole_side(path, camera, "h")


def _focal(path: Path, camera: dict[str, Any], axis: str, extent: int) -> float | None:
    if f"fl_{axis}" in camera:
        return number(path, camera, f"fl_{axis}")
    if f"camera_angle_{axis}" in camera:
        angle = number(path, camera, f"camera_angle_{axis}")
        if not 0 < angle < math.pi:
            raise ValueError(f"{path}: expected camera_angle_{axis} in (0, pi), found {angle:g}")
        return extent / 2 / math.tan(angle / 2)
    return None


def _image_file(path: Path) -> Path | None:
    """Find the image file, adding a suffix that Blender may omit."""
    suffixes = ["", *sorted(IMAGE_SUFFIXES)] if path.suffix.lower() not in IMAGE_SUFFIXES else [""]
    candidates = [path.with_name(path.name + suffix) for suffix in suffixes]
    return next((found for found in map(existing_file, candidates) if found), None)


def write_cameras(path: Path, cameras: Cameras) -> None:
    """Write cameras without images; poses and intrinsics are restored exactly on reading."""
    frames = [{"file_path": name, **_frame(cameras, i, None)} for i, name in enumerate(cameras.names)]
    _dump(path, {"camera_model": "OPENCV"}, frames)


def write_capture(folder: Path, posed_images: PosedImages) -> None:
    """Write transforms.json and points.ply; images and masks are referenced by relative path, not copied."""
    frames = []
    for i, image_path in enumerate(posed_images.image_paths):
        frame: dict[str, Any] = {"file_path": _relative(image_path, folder)}
        mask_path = posed_images.mask_paths[i] if posed_images.mask_paths else None
        if mask_path is not None:
            frame["mask_path"] = _relative(mask_path, folder)
        distortion = posed_images.distortions[i] if posed_images.distortions else None
        frames.append({**frame, **_frame(posed_images.cameras, i, distortion)})
    write_points(folder / "points.ply", posed_images.points, posed_images.point_colors)
    _dump(folder / "transforms.json", {"camera_model": "OPENCV", "ply_file_path": "points.ply"}, frames)


def _relative(path: Path, folder: Path) -> str:
    """Make a path relative, with resolved folders; a symbolic link keeps its own name."""
    return relative_name(path.parent.resolve() / path.name, folder.resolve())


def _frame(cameras: Cameras, index: int, distortion: Distortion | None) -> dict[str, Any]:
    """Make a frame; intrinsics, at the camera's size, are the distorted camera's if the image is distorted."""
    width, height = cameras.sizes[index].tolist()
    matrix = cameras.intrinsics[index].double().cpu().numpy()
    out: dict[str, Any] = {"w": width, "h": height}
    if distortion is not None:
        scale = np.diag([width / distortion.size[0], height / distortion.size[1], 1])
        matrix = scale @ distortion.intrinsics.numpy()
        out |= dict(zip(_COEFFICIENTS, distortion.coefficients.tolist(), strict=True))
    out |= {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    pose = cameras.world_from_camera[index].double().cpu().numpy() @ _OPENCV_FROM_OPENGL
    return {
        **{key: float(value) if isinstance(value, np.floating) else value for key, value in out.items()},
        "transform_matrix": (pose + 0.0).tolist(),
    }


def _dump(path: Path, shared: dict[str, Any], frames: list[dict[str, Any]]) -> None:
    """Write the file; keys with one value in all frames appear once, as in nerfstudio's files."""
    if not frames:
        raise ValueError(f"{path}: expected at least one camera to write, found none")
    same = [k for k in ("w", "h", "fl_x", "fl_y", "cx", "cy", *_COEFFICIENTS) if k in frames[0]]
    if all(frame.get(k) == frames[0].get(k) for frame in frames for k in (*same, *_COEFFICIENTS)):
        shared = {**shared, **{k: frames[0][k] for k in same}}
        frames = [{k: v for k, v in frame.items() if k not in same} for frame in frames]
    save(path, {**shared, "frames": frames})
