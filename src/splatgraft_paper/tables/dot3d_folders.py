"""What the folders of the authors' data set hold, guessed from their names; every guess is a sentence.

The card of the data set names its scenes and the folders above them, but not what a scene's folder holds.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from splatgraft.folders.capture_files import has_poses
from splatgraft.formats import SCENE_SUFFIXES
from splatgraft.project.layout import PLACEMENT_FILE
from splatgraft_paper.tables.paper_numbers import published_name
from splatgraft_paper.tables.paper_scene import LAYOUT_FILE, Kind, PaperScene, from_root, subfolders
from splatgraft_paper.tables.picture_folders import PictureFolder, picture_folders, role_of

_SCENES: dict[Kind, str] = {
    "synthetic": "data_3d/synthetic/insertions",
    "real": "data_3d/real/insertions",
    "rotation": "data_rotation",
}
_RESULTS: dict[Kind, str] = {
    "synthetic": "results_3d/synthetic",
    "real": "results_3d/real",
    "rotation": "results_rotation",
}
_CAPTURES = "data_3d/synthetic/scenes"
_ROOTS = (".", "dot3d_data", "dot3d")
"""Where the folders above may lie below the given one: the card draws them in dot3d_data/."""
_GENERIC = re.compile(r"(ours_\d+|images?|renders?|pictures|png|rgb|test|train|final|results?)", re.IGNORECASE)
"""Folders of results that name no method; ours_30000 is what 3DGS's render.py calls an iteration."""
_POINTS = re.compile(r"(points?(3d)?|input|sparse|point_?cloud_init)", re.IGNORECASE)
"""Names of .ply files that hold the points of structure from motion."""


def find_dot3d(folder: Path) -> tuple[Path, list[PaperScene]]:
    """The data set's root at or below `folder`, and its scenes.

    Raises: ValueError where no folder of the card is there.
    """
    roots = [folder / name for name in _ROOTS]
    root = next((root for root in roots if any((root / part).is_dir() for part in _SCENES.values())), None)
    if root is None:
        raise ValueError(f"{folder}: expected {' or '.join(_SCENES.values())} in it, found none of them")
    scenes = [_inspect(root, kind, name, path) for kind in _SCENES for name, path in _scene_folders(root, kind)]
    return root, [_with_results(scene, root) for scene in _with_poses(scenes)]


def _scene_folders(root: Path, kind: Kind) -> Iterator[tuple[str, Path]]:
    """Name and folder of each scene of a kind; variants of a scene in folders of their own are scenes."""
    base = root / _SCENES[kind]
    for path in subfolders(base):
        nested = [] if kind != "rotation" or _looks_like_scene(path) else subfolders(path)
        if nested:
            yield from ((f"{path.name}_{variant.name}", variant) for variant in nested)
        else:
            yield path.name, path


def _looks_like_scene(folder: Path) -> bool:
    """Whether pictures, a capture or a folder with a role lie directly in it."""
    known = any(role_of(path.name) or _GENERIC.fullmatch(path.name) for path in subfolders(folder))
    return known or has_poses(folder) or any(not found.parts for found in picture_folders(folder))


def _inspect(root: Path, kind: Kind, name: str, folder: Path) -> PaperScene:
    """Guess what the folder of a scene holds."""
    folders, taken = _roles(picture_folders(folder), root)
    files: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        key = _file_role(path, folder)
        if key is not None and key not in files:
            files[key] = path.parent if key == "cameras" else path
            taken.append(f"{from_root(files[key], root)}: taken for the {key.replace('_', ' ')}, by its name")
    object_name, _, background_name = name.partition("_in_")
    captures = {"source_capture": ("objects", object_name), "target_capture": ("backgrounds", background_name)}
    for key, (group, part) in captures.items():
        path = root / _CAPTURES / group / part
        if kind == "synthetic" and part and path.is_dir():
            files[key] = path
            taken.append(f"{from_root(path, root)}: taken for the {key.replace('_', ' ')}, by the scene's name")
    if "truth" not in folders:
        taken.append("no pictures with the object really in the scene were found: only numbers that need no truth")
    return PaperScene(name, kind, folders=folders, files=files, taken=tuple(taken))


def _roles(found: list[PictureFolder], root: Path) -> tuple[dict[str, Path], list[str]]:
    """Folders by role, with a sentence for each folder of pictures."""
    folders: dict[str, Path] = {}
    taken: list[str] = []
    # the shallowest folder of a role, and images before images_4, which 3DGS captures hold at a fraction of the size
    for one in sorted(found, key=lambda item: (len(item.parts), item.parts)):
        where = from_root(one.path, root)
        if one.role is None:
            continue
        if one.role in folders:
            taken.append(f"{where}: not used, as {from_root(folders[one.role], root)} was taken for the {one.role}")
        else:
            folders[one.role] = one.path
            taken.append(f"{where}: taken for the {one.role}, by its name")
    unnamed = [one for one in found if one.role is None]
    if len(unnamed) == 1 and "truth" in folders and "composite" not in folders:
        folders["composite"] = unnamed[0].path
        where = from_root(unnamed[0].path, root)
        taken.append(f"{where}: taken for the composite, as the only other pictures beside the truth")
        unnamed = []
    for one in unnamed:
        said = f"not used, as its name does not say what it shows; name it in {LAYOUT_FILE}"
        taken.append(f"{from_root(one.path, root)}: {said}")
    return folders, taken


def _file_role(path: Path, folder: Path) -> str | None:
    """The role of a file or a capture by its name."""
    if path.name == PLACEMENT_FILE:
        return "placement"
    parts = path.relative_to(folder).parts
    if path.suffix.lower() in SCENE_SUFFIXES and not _POINTS.fullmatch(path.stem):
        words = {word for part in parts for word in re.split(r"[^a-z0-9]+", part.lower().removesuffix(path.suffix))}
        if words & {"object", "obj", "foreground", "fg", "source"}:
            return "object_scene"
        if words & {"background", "bg", "target", "scene"}:
            return "target_scene"
    # a capture's poses: in the scene's folder itself, or in that of the composite or the truth
    if path.name in ("transforms.json", "transforms_train.json", "sparse") and has_poses(path.parent):
        return "cameras"
    return None


def _with_poses(scenes: list[PaperScene]) -> list[PaperScene]:
    """P0, P1, P2 in the order of the names of the rotations of one scene."""
    counted: dict[str, int] = {}
    out = []
    for scene in scenes:
        if scene.kind == "rotation":
            base = re.sub(r"[_\-]?(rotation|rot|pose|p|r)?[_\-]?\d+$", "", scene.name, flags=re.IGNORECASE)
            counted[base] = counted.get(base, -1) + 1
            pose = f"P{counted[base]}"
            taken = (*scene.taken, f"{scene.name}: taken for pose {pose} of {base}, by the order of the names")
            out.append(replace(scene, pose=pose, taken=taken))
        else:
            out.append(scene)
    return out


def _with_results(scene: PaperScene, root: Path) -> PaperScene:
    """Add the authors' pictures: RESULTS/SCENE/METHOD/.. or RESULTS/METHOD/SCENE/.., in either order."""
    base = root / _RESULTS[scene.kind]
    results: dict[str, Path] = {}
    folders, taken = dict(scene.folders), list(scene.taken)
    for one in picture_folders(base) if base.is_dir() else []:
        rest = _without_scene(one.parts, scene.name)
        if rest is None:
            continue
        where = from_root(one.path, root)
        # a result folder of 3DGS holds gt/ beside renders/
        role = role_of(one.parts[-1]) if len(one.parts) > 1 else None
        if role is not None and role != "composite":
            if role not in folders:
                folders[role] = one.path
                taken.append(f"{where}: taken for the {role}, by its name")
            continue
        method = published_name(next((part for part in rest if not _GENERIC.fullmatch(part)), "Ours"))
        if method in results and not _better(one.path, results[method]):
            taken.append(f"{where}: not used, as {from_root(results[method], root)} was taken for {method}")
            continue
        results[method] = one.path
        taken.append(f"{where}: taken for the authors' pictures of {method}")
    if not results:
        taken.append(f"{from_root(base, root)}: no pictures of this scene were found")
    return replace(scene, folders=folders, results=results, taken=tuple(taken))


def _better(path: Path, than: Path) -> bool:
    """Whether a result folder is that of the test views, and the other one is not."""
    return "test" in path.parts and "test" not in than.parts


def _without_scene(parts: tuple[str, ...], name: str) -> tuple[str, ...] | None:
    """The parts beside the scene's name, which may be one folder or two; None where it is not in them."""
    for start in range(len(parts)):
        for count in (1, 2):
            if "_".join(parts[start : start + count]) == name:
                return (*parts[:start], *parts[start + count :])
    return None
