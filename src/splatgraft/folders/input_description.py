"""Recognition of a user's input before a project is made of it: photos, a video, a posed capture or a scene."""

from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

from splatgraft.capture import MIN_VIEWS, describe_video
from splatgraft.folders.capture_files import has_poses
from splatgraft.formats import has_known_surface, is_scene, read_capture, read_gaussians
from splatgraft.formats.captures.masks import describe_masks, find_photos
from splatgraft.formats.captures.photo_archive import count_archived_photos, is_archive
from splatgraft.project.layout import PROJECT_FILE, SCENE_FILE

InputKind = Literal["photos", "video", "posed capture", "scene", "project", "nothing"]
_FOLDERS = (f"target/scene/{SCENE_FILE}", f"result/{SCENE_FILE}", SCENE_FILE)
"""Scenes in folders of results."""


@dataclass(frozen=True)
class InputDescription:
    """The recognised kind of a path, with a line for the user."""

    kind: InputKind
    """Kind of the input; `nothing` if no other kind fits."""
    text: str
    """Line for the user: the content of the input and its use."""

    @property
    def is_usable(self) -> bool:
        """Whether a project can be made of it."""
        return self.kind not in ("project", "nothing")


def require_input(path: Path) -> None:
    """Raise ValueError if nothing is at a path, and name the most similar file in its folder."""
    if path.exists():
        return
    expected = f"{path}: expected photos, a video, a posed capture or a scene, found nothing there"
    inside = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
    meant = get_close_matches(path.name, inside, 1)
    raise ValueError(f"{expected}; did you mean {path.parent / meant[0]}?" if meant else expected)


def describe_input(path: Path) -> InputDescription:
    """Recognise the input at a path, which need not exist; nothing is changed."""
    try:
        return _described(path)
    except (ValueError, OSError) as error:
        return InputDescription("nothing", " ".join(str(error).split()))


def _described(path: Path) -> InputDescription:
    require_input(path)
    if path.name == PROJECT_FILE or (path / PROJECT_FILE).is_file():
        folder = path.parent if path.is_file() else path
        return InputDescription("project", f"a project of its own: splatgraft edit {folder}")
    if is_scene(path):
        return _scene(path)
    if has_poses(path):
        posed = read_capture(path)
        masks = describe_masks(posed.image_paths, posed.mask_paths)
        return InputDescription(
            "posed capture", f"a capture of {len(posed)} images with poses, {masks}: a scene is trained on it"
        )
    if is_archive(path):
        return _photos(path, count_archived_photos(path), "unpacked first")
    if path.is_file():
        return InputDescription(
            "video", f"{describe_video(path)}: frames are taken, camera positions will be found and the scene built"
        )
    return _folder_of_photos(path)


def _scene(path: Path) -> InputDescription:
    if has_known_surface(path):
        count = read_gaussians(path).count
        return InputDescription("scene", f"a mesh, covered by {count:,} Gaussians of known normals and materials")
    size = sum(p.stat().st_size for p in ([path] if path.is_file() else path.iterdir()) if p.is_file())
    count = "" if size > 1 << 30 else f" of {read_gaussians(path).count:,} Gaussians"
    return InputDescription("scene", f"a trained scene{count}: images are rendered from it, nothing is trained")


def _folder_of_photos(path: Path) -> InputDescription:
    result = next((path / name for name in _FOLDERS if (path / name).is_file()), None)
    if result is not None:
        return InputDescription("nothing", f"a folder of results; name the scene in it: {result}")
    photos = find_photos(path)
    return _photos(path, len(photos.paths), describe_masks(photos.paths, photos.masks))


def _photos(path: Path, count: int, more: str) -> InputDescription:
    if count < MIN_VIEWS:
        raise ValueError(f"{path}: expected at least {MIN_VIEWS} photos, found {count}")
    following = "ready: camera positions will be found and the scene built"
    return InputDescription("photos", f"{count} photos, {more}; {following}")
