"""Reads and writes scenes, captures and cameras, in the format given by the suffix or by the files in a folder."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures import read_capture_file
from splatgraft.formats.captures.transforms_json import write_cameras, write_capture
from splatgraft.formats.captures.views import ViewRecord, cameras, posed_images
from splatgraft.formats.scenes.axes import with_axes
from splatgraft.formats.scenes.compressed_ply import COMPRESSED_PLY, write_compressed_ply
from splatgraft.formats.scenes.gaussian_glb import read_gaussian_glb, write_gaussian_glb
from splatgraft.formats.scenes.gaussian_ply import read_gaussian_ply, write_gaussian_ply
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


_READERS = {
    ".ply": read_gaussian_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".sog": read_sog,
    ".glb": read_gaussian_glb,
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

SCENE_SUFFIXES = tuple(_READERS)
"""Suffixes of trained scenes that can be read; a folder of SOG pictures has none."""

WRITTEN_SCENE_SUFFIXES = tuple(_WRITERS)
"""Suffixes of scenes that can be written."""


def is_scene(path: Path) -> bool:
    """Whether the suffix is that of a trained scene, or it is a folder of SOG pictures or the meta.json of one."""
    return path.suffix.lower() in _READERS or is_sog_folder(path)


def scene_files(path: Path) -> tuple[Path, ...]:
    """The files of a trained scene: itself, or the files of a folder of SOG pictures."""
    return sog_files(path) if is_sog_folder(path) else (path,)


def read_gaussians(path: Path | str) -> Gaussians:
    """Read a trained scene, taking the word of the file's layout.

    Args:
        path: A .ply (of 3DGS, or SuperSplat's compressed form), .spz, .splat, .sog, .glb or .ksplat file, or a folder
            of SOG pictures.

    Returns:
        Its Gaussians, in the file's order, and in the axes of a .ply where the format has others.

    Raises:
        ValueError: The suffix is another, or the file is not what its suffix says.
    """
    return _read(Path(path)).gaussians


def read_scene(path: Path | str, *, axes: str | None = None) -> SceneFile:
    """Read a trained scene of another program, with what is known of its frame.

    `axes` are the directions of the file's x, y and z, such as RDF or RUB, where those of the format are wrong.
    """
    scene = _read(Path(path))
    return scene if axes is None else with_axes(scene, axes)


def _read(path: Path) -> SceneFile:
    with _readable(path):
        read = read_sog if is_sog_folder(path) else _by_suffix(path, _READERS)
        if not path.exists():
            raise ValueError(f"{path}: expected a trained scene, found none")
        try:
            return read(path)
        except OSError:
            raise
        except Exception as error:  # a damaged file makes its parser raise any kind of error
            if isinstance(error, ValueError) and str(path) in str(error):
                raise
            found = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            raise ValueError(f"{path}: expected a whole {path.suffix} scene, found {found}") from error


def write_gaussians(path: Path | str, gaussians: Gaussians, *, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write a scene in the format of the suffix; the file appears whole or not at all.

    Args:
        path: A file that ends in .ply (exact), .glb (float32), .sog, .spz, .compressed.ply or .splat
            (quantised; .sog and .compressed.ply change the order, .splat keeps band 0 of the colour only).
        gaussians: The scene, on the CPU.
        metadata: What is known of its frame; left out of .spz and .splat, which have no room for it.

    Raises:
        ValueError: The suffix is another, or the format cannot hold the scene.
    """
    _by_suffix(Path(path), _WRITERS)(Path(path), gaussians, metadata)


def scene_suffix(path: Path) -> str:
    """The suffix that names the format of a scene to write: the last one, or .compressed.ply."""
    return COMPRESSED_PLY if path.name.lower().endswith(COMPRESSED_PLY) else path.suffix.lower()


def _by_suffix(path: Path, functions: dict[str, Callable]) -> Callable:
    function = functions.get(scene_suffix(path)) or functions.get(path.suffix.lower())
    if function is None:
        raise ValueError(f"{path}: expected a scene that ends in {', '.join(functions)}, found '{path.suffix}'")
    return function


def read_capture(path: Path | str) -> PosedImages:
    """Read a capture: posed images, sparse points, and object masks where there are some.

    Args:
        path: A folder with transforms.json (or Blender's transforms_train.json), that file itself, or a COLMAP folder;
            of a folder with both, transforms.json is read. Masks are found by file name in masks/, or in the alpha
            channel of the images.

    Returns:
        The capture; image files are read when asked for.

    Raises:
        ValueError: There is none of these at `path`, or a file is broken.
    """
    with _readable(Path(path)):
        return posed_images(read_capture_file(Path(path)))


def read_images(path: Path) -> PosedImages:
    """Posed photographs without points, as of a ground truth; a points file need not exist."""
    with _readable(path):
        return posed_images(read_capture_file(path), with_points=False)


def read_cameras(path: Path | str) -> Cameras:
    """Read the cameras of a capture, whose images need not exist.

    Args:
        path: A capture folder, a transforms.json, or a cameras.json of the original 3DGS code.

    Returns:
        Undistorted pinhole cameras, in the file's order and frame.

    Raises:
        ValueError: There is none of these at `path`, or a file is broken.
    """
    with _readable(Path(path)):
        return cameras(read_capture_file(Path(path)))


def list_capture_images(path: Path) -> list[Path]:
    """The image files of a capture that exist; none for a cameras.json."""
    with _readable(path):
        views = read_capture_file(path).views
    return [view.image_path for view in views if isinstance(view, ViewRecord) and view.image_path]


@contextmanager
def _readable(path: Path) -> Generator[None]:
    """Turns the system's errors (permissions, impossible names) into a ValueError that names the file."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"{error.filename or path}: expected a readable file, found {error.strerror}") from error
