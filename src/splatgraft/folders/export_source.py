"""Sources of an export: a scene file, the folder of a result, or a whole project."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.exports.export_source import ExportSource
from splatgraft.folders.composite_folder import guessed_gaussians, photographed_side
from splatgraft.formats import is_scene, read_cameras, read_gaussians, read_scene
from splatgraft.formats.scenes.scene_file import SceneMetadata
from splatgraft.project.gaussian_flags import read_selection
from splatgraft.project.layout import (
    CAMERAS_FILE,
    IS_OBJECT_FILE,
    PLACEMENT_FILE,
    PROJECT_FILE,
    SCENE_FILE,
    Layout,
)
from splatgraft.project.metric_scale import read_scale
from splatgraft.project.placement import read_placement


def read_export_source(path: Path, *, cameras: Path | None = None) -> ExportSource:
    """Read a scene, a result or a project for export.

    Args:
        path: A scene file, a folder with scene.ply, a project's folder or its project.toml. For a project, and for the
            folders of `relight` and `consolidate` in it, the parts and the scene before the transfer are read as well.
        cameras: Capture of the scene, in the same frame; a project's own if None.
    """
    if path.name == PROJECT_FILE:
        path = path.parent
    if not path.exists():
        raise ValueError(f"{path}: expected a scene, a folder with {SCENE_FILE} or a project, found nothing there")
    if is_scene(path):
        return _of_scene(path, cameras)
    root = project_of(path)
    if root is not None:
        last = path if (path / SCENE_FILE).is_file() else _last_result(Layout(root))
        return _of_project(Layout(root), last, cameras)
    if (path / SCENE_FILE).is_file():
        capture = path.parent / "capture"
        found = capture if cameras is None and (capture / CAMERAS_FILE).is_file() else cameras
        return _of_scene(path / SCENE_FILE, found)
    raise ValueError(
        f"{path}: expected a scene, a folder with {SCENE_FILE} or a project with relit/{SCENE_FILE}, found none of them"
    )


def project_of(path: Path) -> Path | None:
    """Find the project of `path`: the project's folder, or the folder of its relit or consolidated result."""
    for root, result in ((path, path / "relit"), (path.parent, path)):
        layout = Layout(root)
        known = result in (layout.relit, layout.result)
        files = (result / SCENE_FILE, layout.relit / IS_OBJECT_FILE, layout.composite / SCENE_FILE)
        if known and all(file.is_file() for file in files):
            return root
    return None


def _last_result(layout: Layout) -> Path:
    return layout.result if (layout.result / SCENE_FILE).is_file() else layout.relit


def _of_scene(path: Path, capture: Path | None) -> ExportSource:
    scene = read_scene(path)
    cameras = None if capture is None else read_cameras(capture)
    metres = None if capture is None else read_scale(capture)
    up = scene.metadata.up if cameras is None else _up(cameras)
    known = SceneMetadata(up, None if metres is None else metres.metres_per_unit)
    return ExportSource(scene=scene.gaussians, title=_title(path), cameras=cameras, metadata=known)


def _of_project(layout: Layout, last: Path, capture: Path | None) -> ExportSource:
    """Read the last result and the composite; consolidation keeps order and number of the relit Gaussians."""
    scene = read_gaussians(last / SCENE_FILE)
    is_object = read_selection(layout.relit / IS_OBJECT_FILE, scene.count, last / SCENE_FILE)
    capture = layout.capture("target") if capture is None else capture
    cameras = read_cameras(capture) if capture.exists() else None
    metres = read_scale(capture) if cameras is not None else None
    place = layout.scene("target") / SCENE_FILE
    target = read_gaussians(place) if place.is_file() else None
    if target is not None and (layout.composite / PLACEMENT_FILE).is_file():
        erased = read_placement(layout.composite / PLACEMENT_FILE).erased
        target = target if erased is None else target.select(~torch.as_tensor(erased))
    up = None if cameras is None else _up(cameras)
    pasted = read_gaussians(layout.composite / SCENE_FILE)
    return ExportSource(
        scene=scene,
        title=_title(layout.root.resolve()),
        is_object=is_object,
        pasted=pasted,
        place=target,
        cameras=cameras,
        photographed_side=None if up is None else _photographed_side(layout.composite, pasted, torch.tensor(up)),
        metadata=SceneMetadata(up, None if metres is None else metres.metres_per_unit),
    )


def _photographed_side(composite: Path, pasted: Gaussians, up: Float[Tensor, "3"]) -> Float[Tensor, "3"] | None:
    is_object = read_selection(composite / IS_OBJECT_FILE, pasted.count, composite / SCENE_FILE)
    return photographed_side(pasted, is_object, guessed_gaussians(composite, is_object), up)


def _up(cameras: Cameras) -> tuple[float, float, float]:
    x, y, z = estimate_up(cameras).tolist()
    return x, y, z


def _title(path: Path) -> str:
    """Make a title of the name of a file or folder."""
    name = path.parent.name if path.name == SCENE_FILE and path.parent.name else path.stem
    return name.replace("_", " ").replace("-", " ").strip().capitalize() or "Scene"
