"""The authors' published data set on disk: finds its scenes and their files, and matches pictures to views.

The data set is nviolante/dot3d on Hugging Face, CC-BY 4.0. Its card names the folders down to SCENE, and the scenes.
It does not name what lies below a SCENE; those names are ours and can be replaced (`NAMES`):

    data_3d/{synthetic,real}/insertions/SCENE/      SCENE is OBJECT_in_BACKGROUND
        gt/  background/  composite/  masks/        pictures VIEW.png: with the object, without it, pasted; its mask
        object.ply  background.ply                  trained Gaussians, the object at its place in the background
        transforms.json  placement.json             cameras of the views; pose of the object in the background
    data_3d/synthetic/scenes/{objects,backgrounds}/NAME     captures
    data_rotation/SCENE/POSE/  or SCENE_POSE/       files of a SCENE; the poses' names sort in their order
    results_3d/{synthetic,real}/METHOD/SCENE/       the authors' pictures VIEW.png; METHOD and SCENE in either order,
    results_rotation/METHOD/SCENE/POSE/             and further folders below; without a METHOD they are of "Ours"
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch

from splatgraft.core.images import IMAGE_SUFFIXES
from splatgraft.core.posed_images import held_out
from splatgraft.project.layout import PLACEMENT_FILE
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY
from splatgraft_paper.tables.paper_numbers import published_name

Kind = Literal["synthetic", "real", "rotation"]
_PARTS = ("data_3d", "data_rotation", "results_3d", "results_rotation")
_PICTURES = {"truth": "gt", "background": "background", "composite": "composite", "masks": "masks"}
_FILES = {
    "object_scene": "object.ply",
    "target_scene": "background.ply",
    "cameras": "transforms.json",
    "placement": PLACEMENT_FILE,
}
NAMES = {**_PICTURES, **_FILES, "results": ""}
"""Path below a scene's folder by role; `results` is the path of the pictures below METHOD/SCENE."""


@dataclass(frozen=True)
class PaperScene:
    """Existing folders and files of one scene."""

    name: str
    kind: Kind
    pose: str = ""
    """P0, P1 or P2 in the rotation experiment."""
    folders: Mapping[str, Path] = field(default_factory=dict)
    """Folders of pictures by role: truth, composite, background, masks."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Files by role: target_scene, object_scene (trained .ply), cameras, placement, source_capture, target_capture."""
    results: Mapping[str, Path] = field(default_factory=dict)
    """Folders of the authors' pictures by method."""
    lacks: str = ""
    """Reason why nothing can be measured on the scene, with the names that its folder has; else empty."""


def find_scenes(folder: Path, names: Mapping[str, str] = {}) -> tuple[PaperScene, ...]:
    """List the scenes of the data set in `folder`, or in dot3d_data/ there; `names` replaces some of `NAMES`."""
    root = next(
        (root for root in (folder, folder / "dot3d_data") if any((root / p).is_dir() for p in _PARTS[:2])), None
    )
    if root is None:
        raise ValueError(f"{folder}: expected {_PARTS[0]} or {_PARTS[1]} in it, found neither")
    found = _Finder(root, {**NAMES, **names})
    scenes: list[PaperScene] = []
    for kind in ("synthetic", "real"):
        shown = found.shown(root / "results_3d" / kind)
        for path in _subfolders(root / "data_3d" / kind / "insertions"):
            scenes.append(found.scene(kind, (path.name,), path, shown))
    shown = found.shown(root / "results_rotation")
    for place, poses in found.rotations().items():
        for number, (pose, path) in enumerate(poses):
            scenes.append(found.scene("rotation", (place, pose), path, shown, pose=f"P{number}"))
    if not scenes:
        raise ValueError(f"{root}: expected folders of scenes in data_3d/KIND/insertions or data_rotation, found none")
    return tuple(scenes)


@dataclass(frozen=True)
class _Finder:
    """Search for the files of scenes below a root, by their names."""

    root: Path
    names: Mapping[str, str]

    def shown(self, results: Path) -> dict[tuple[str, ...], Path]:
        """List the folders of pictures below `results` by the parts of their path, without the name for `results`."""
        inner = Path(self.names["results"]).parts
        found: dict[tuple[str, ...], Path] = {}
        for path in _picture_folders(results):
            parts = path.relative_to(results).parts
            if parts[len(parts) - len(inner) :] == inner:
                found[parts[: len(parts) - len(inner)]] = path
        return found

    def rotations(self) -> dict[str, list[tuple[str, Path]]]:
        """List the poses by scene, from SCENE/POSE or SCENE_POSE; a folder with files of a scene is one pose."""
        poses: dict[str, list[tuple[str, Path]]] = {}
        for path in _subfolders(self.root / "data_rotation"):
            if any((path / self.names[role]).exists() for role in (*_PICTURES, *_FILES)):
                place, _, pose = path.name.rpartition("_")
                poses.setdefault(place or path.name, []).append((pose, path))
            else:
                poses[path.name] = [(below.name, below) for below in _subfolders(path)]
        return poses

    def scene(
        self, kind: Kind, parts: tuple[str, ...], folder: Path, shown: Mapping[tuple[str, ...], Path], pose: str = ""
    ) -> PaperScene:
        """Find the files of one scene; `parts` are the parts of its name."""
        folders = {role: folder / self.names[role] for role in _PICTURES if (folder / self.names[role]).is_dir()}
        files = {role: folder / self.names[role] for role in _FILES if (folder / self.names[role]).exists()}
        thing, _, background = parts[-1].partition("_in_")
        captures = self.root / "data_3d" / "synthetic" / "scenes"
        for role, path in {
            "source_capture": captures / "objects" / thing,
            "target_capture": captures / "backgrounds" / background,
        }.items():
            if background and path.is_dir():
                files[role] = path
        needed = ("composite", "background") if kind == "real" else ("truth",)
        lacks = ""
        if not any(role in folders for role in needed):
            expected = " or ".join(f"{self.names[role]}/ ({role})" for role in needed)
            held = ", ".join(sorted(p.name + "/" * p.is_dir() for p in folder.iterdir())) or "nothing"
            lacks = f"{folder}: expected {expected}, found {held}; other names: --names {needed[0]}=NAME"
        return PaperScene("_".join(parts), kind, pose, folders, files, _by_method(parts, shown), lacks)


def _by_method(name: tuple[str, ...], shown: Mapping[tuple[str, ...], Path]) -> dict[str, Path]:
    """Select the pictures of one scene; the part of their path that does not name the scene names the method."""
    found: dict[str, dict[tuple[str, ...], Path]] = {}
    for parts, path in shown.items():
        for form in (name, ("_".join(name),)):
            if set(form) <= set(parts):
                rest = tuple(part for part in parts if part not in form) or ("Ours",)
                found.setdefault(rest[0], {})[rest[1:]] = path
                break
    return {
        "/".join((published_name(method), *rest)) if len(paths) > 1 else published_name(method): path
        for method, paths in found.items()
        for rest, path in paths.items()
    }


def _picture_folders(folder: Path) -> Iterator[Path]:
    """List the folders at or below `folder` that hold pictures, in the order of their names."""
    for path, below, files in os.walk(folder):
        below.sort()
        if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in files):
            yield Path(path)


def pictures(folder: Path) -> dict[str, Path]:
    """List the pictures directly in `folder` by the stem of their name, in numerical order."""
    names = [path.name for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES] if folder.is_dir() else []
    if not names:
        raise ValueError(f"{folder}: expected pictures, found {'none' if folder.is_dir() else 'no such folder'}")
    return {Path(name).stem: folder / name for name in sorted(names, key=_in_order)}


def held_out_stems(stems: Sequence[str]) -> list[str]:
    """Select every 8th view from the first, in the order of the names, as Mip-NeRF 360 and 3DGS hold out."""
    chosen = torch.nonzero(held_out(len(stems), HELD_OUT_EVERY)).flatten().tolist()
    return [stems[int(index)] for index in chosen]


def match_views(wanted: Sequence[str], found: dict[str, Path]) -> tuple[dict[str, Path], str]:
    """Match a method's pictures to views, and describe how.

    Pictures are matched by name, else by order. Order requires numbers as names, as from 3DGS's render.py, and one
    picture for each view or for each held-out view. The result is empty if neither fits.
    """
    if same := {stem: found[stem] for stem in wanted if stem in found}:
        return same, f"{len(same)} of {len(wanted)} views by name"
    paths = list(found.values())
    numbered = all(stem.isdigit() for stem in found)
    for views, what in ((list(wanted), "all"), (held_out_stems(wanted), "the held-out")):
        if numbered and len(paths) == len(views):
            return dict(zip(views, paths, strict=True)), f"{what} {len(views)} views by order, as pictures are numbered"
    return {}, f"none of {len(found)} pictures fits {len(wanted)} views, neither by name nor by number"


def named_folders(names: tuple[str, ...]) -> dict[str, str]:
    """Parse the words ROLE=NAME of --names."""
    named = dict((text.partition("=")[0], text.partition("=")[2]) for text in names)
    if not named.keys() <= NAMES.keys() or not all(named.values()):
        raise ValueError(f"--names: expected ROLE=NAME with ROLE of {', '.join(NAMES)}, found {' '.join(names)}")
    return named


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def _in_order(name: str) -> list[tuple[int, str | int]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", Path(name).stem)]
