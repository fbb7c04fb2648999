"""Reading and writing of scenes, captures and cameras; the suffix, or the files in a folder, give the format."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.mesh_sampling import DEFAULT_BUDGET
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures import read_capture_file
from splatgraft.formats.captures.transforms_json import write_cameras, write_capture
from splatgraft.formats.captures.views import ViewRecord, cameras, posed_images
from splatgraft.formats.meshes import SUFFIXES as MESH_SUFFIXES
from splatgraft.formats.meshes import has_known_surface, read_surface
from splatgraft.formats.parsing import parsing
from splatgraft.formats.scenes.axes import with_axes
from splatgraft.formats.scenes.compressed_ply import COMPRESSED_PLY, write_compressed_ply
from splatgraft.formats.scenes.gaussian_glb import write_gaussian_glb
from splatgraft.formats.scenes.gaussian_ply import write_gaussian_ply
from splatgraft.formats.scenes.ksplat import read_ksplat
from splatgraft.formats.scenes.ply import read_points, write_points
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata
from splatgraft.formats.scenes.sog import is_sog_folder, read_sog, sog_files, write_sog
from splatgraft.formats.scenes.splat import read_splat, write_splat
from splatgraft.formats.scenes.spz import read_spz, write_spz

__all__ = [
    "SCENE_SUFFIXES",
    "WRITTEN_SCENE_SUFFIXES",
    "SceneFile",
    "SceneMetadata",
    "has_known_surface",
    "is_scene",
    "list_capture_images",
    "read_cameras",
    "read_capture",
    "read_gaussians",
    "read_images",
    "read_points",
    "read_scene",
    "scene_files",
    "scene_suffix",
    "write_cameras",
    "write_capture",
    "write_gaussians",
    "write_points",
]


_READERS: dict[str, Callable[[Path], SceneFile]] = {
    ".spz": read_spz,
    ".splat": read_splat,
    ".sog": read_sog,
    ".ksplat": read_ksplat,
}
_WRITERS = {
    ".ply": write_gaussian_ply,
    COMPRESSED_PLY: write_compressed_ply,
    ".sog": write_sog,
    ".spz": write_spz,
    ".splat": write_splat,
    ".glb": write_gaussian_glb,
}

SCENE_SUFFIXES = (*_READERS, *MESH_SUFFIXES)
"""Suffixes of trained scenes and meshes that can be read; a folder of SOG images has none."""

WRITTEN_SCENE_SUFFIXES = tuple(_WRITERS)
"""Suffixes of scenes that can be written."""


def is_scene(path: Path) -> bool:
    """Whether the suffix is that of a trained scene or a mesh, or the path is a folder of SOG images or its
    meta.json."""
    return path.suffix.lower() in SCENE_SUFFIXES or is_sog_folder(path)


def scene_files(path: Path) -> tuple[Path, ...]:
    """List the files of a trained scene: the file itself, or those of a folder of SOG images."""
    return sog_files(path) if is_sog_folder(path) else (path,)


def read_gaussians(path: Path | str) -> Gaussians:
    """Read a trained scene, or a mesh.

    Args:
        path: A .ply (of 3DGS, or SuperSplat's compressed form), .spz, .splat, .sog, .glb or .ksplat file, or a folder
            of SOG images; or a mesh: .glb, .gltf, .obj, .stl or .ply.

    Returns:
        The Gaussians in the file's order, or those of a mesh as a `KnownSurface`; other axes are turned to those of
        a .ply.

    Raises:
        ValueError: The suffix is not supported, or the file does not match its suffix.
    """
    return _read(Path(path)).gaussians


def read_scene(path: Path | str, *, axes: str | None = None, mesh_budget: int = DEFAULT_BUDGET) -> SceneFile:
    """Read a trained scene of another program, or a mesh, with the up direction and size that the file states.

    `axes` are the directions of the file's x, y and z, such as RDF or RUB, if they differ from the format's.
    `mesh_budget` is the largest number of Gaussians that cover a mesh.
    """
    scene = _read(Path(path), mesh_budget)
    return scene if axes is None else with_axes(scene, axes)


def _read(path: Path, mesh_budget: int = DEFAULT_BUDGET) -> SceneFile:
    with parsing(path):
        meshes = dict.fromkeys(MESH_SUFFIXES, partial(read_surface, budget=mesh_budget))
        read = read_sog if is_sog_folder(path) else _by_suffix(path, _READERS | meshes)
        if not path.exists():
            raise ValueError("expected a trained scene, found none")
        scene = read(path)
        shapes = [tuple(field.shape) for field in vars(scene.gaussians).values()]
        if len({shape[0] for shape in shapes}) > 1 or scene.gaussians.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"expected fields of one length, and 1, 4, 9 or 16 SH coefficients, found {shapes}")
    return scene


def write_gaussians(path: Path | str, gaussians: Gaussians, *, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write a scene in the format of its suffix, atomically.

    Args:
        path: A file that ends in .ply (exact), .glb (float32), .sog, .spz, .compressed.ply or .splat
            (quantised; .sog and .compressed.ply change the order, .splat keeps band 0 of the colour only).
        gaussians: The scene, on the CPU.
        metadata: Up direction and size of the scene; .spz and .splat cannot store them.

    Raises:
        ValueError: The suffix is not supported, or the format cannot hold the scene.
    """
    _by_suffix(Path(path), _WRITERS)(Path(path), gaussians, metadata)


def scene_suffix(path: Path) -> str:
    """Return the suffix that names the format of a scene to write: the last one, or .compressed.ply."""
    return COMPRESSED_PLY if path.name.lower().endswith(COMPRESSED_PLY) else path.suffix.lower()


def _by_suffix(path: Path, functions: dict[str, Callable]) -> Callable:
    function = functions.get(scene_suffix(path)) or functions.get(path.suffix.lower())
    if function is None:
        raise ValueError(f"{path}: expected a scene that ends in {', '.join(functions)}, found '{path.suffix}'")
    return function


def read_capture(path: Path | str) -> PosedImages:
    """Read a capture: posed images, sparse points, and object masks if there are any.

    Args:
        path: A folder with transforms.json (or Blender's transforms_train.json), that file itself, or a COLMAP folder;
            transforms.json is preferred. Masks are found by file name in masks/, or in the alpha channel of the images.

    Returns:
        The capture; image files are read on access.

    Raises:
        ValueError: There is no capture at `path`, or a file is broken.
    """
    with parsing(Path(path)):
        return posed_images(read_capture_file(Path(path)))


def read_images(path: Path) -> PosedImages:
    """Read posed photographs without points, for example a ground truth; a points file need not exist."""
    with parsing(path):
        return posed_images(read_capture_file(path), with_points=False)


def read_cameras(path: Path | str) -> Cameras:
    """Read the cameras of a capture, whose images need not exist.

    Args:
        path: A capture folder, a transforms.json, or a cameras.json of the original 3DGS code.

    Returns:
        Undistorted pinhole cameras, in the file's order and frame.

    Raises:
        ValueError: There are no cameras at `path`, or a file is broken.
    """
    with parsing(Path(path)):
        return cameras(read_capture_file(Path(path)))


def list_capture_images(path: Path) -> list[Path]:
    """List the existing image files of a capture; none for a cameras.json."""
    with parsing(path):
        views = read_capture_file(path).views
    return [view.image_path for view in views if isinstance(view, ViewRecord) and view.image_path]
