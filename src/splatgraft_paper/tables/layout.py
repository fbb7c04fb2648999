"""The authors' published data set on disk: finds its scenes and their files, and matches pictures to views.

The data set is nviolante/dot3d on Hugging Face, CC-BY 4.0. Its card names the folders down to SCENE. It does not
name the files below SCENE; the names here are ours, so files may have to be renamed:

    data_3d/{synthetic,real}/insertions/SCENE/      SCENE is OBJECT_in_BACKGROUND
        gt/  background/  composite/                pictures VIEW.png: with the object, without it, pasted
        object.ply  background.ply                  trained Gaussians, the object at its place in the background
        transforms.json  placement.json             cameras of the views; pose of the object in the background
    data_3d/synthetic/scenes/{objects,backgrounds}/NAME     captures
    data_rotation/SCENE/POSE/                       files of a SCENE; the poses' names sort in their order
    results_3d/{synthetic,real}/METHOD/SCENE/VIEW.png       the authors' pictures
    results_rotation/METHOD/SCENE/POSE/VIEW.png
"""

import re
from collections.abc import Mapping, Sequence
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
_PICTURES = {"truth": "gt", "background": "background", "composite": "composite"}
_FILES = {
    "object_scene": "object.ply",
    "target_scene": "background.ply",
    "cameras": "transforms.json",
    "placement": PLACEMENT_FILE,
}


@dataclass(frozen=True)
class PaperScene:
    """Existing folders and files of one scene."""

    name: str
    kind: Kind
    pose: str = ""
    """P0, P1 or P2 in the rotation experiment."""
    folders: Mapping[str, Path] = field(default_factory=dict)
    """Folders of pictures by role: truth, composite, background."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Files by role: target_scene, object_scene (trained .ply), cameras, placement, source_capture, target_capture."""
    results: Mapping[str, Path] = field(default_factory=dict)
    """Folders of the authors' pictures by method."""


def find_scenes(folder: Path) -> tuple[PaperScene, ...]:
    """List the scenes of the data set in `folder`, or in dot3d_data/ there."""
    root = next(
        (root for root in (folder, folder / "dot3d_data") if any((root / p).is_dir() for p in _PARTS[:2])), None
    )
    if root is None:
        raise ValueError(f"{folder}: expected {_PARTS[0]} or {_PARTS[1]} in it, found neither")
    scenes: list[PaperScene] = []
    for kind in ("synthetic", "real"):
        for path in _subfolders(root / "data_3d" / kind / "insertions"):
            scenes.append(_scene(root, kind, path.name, path, root / "results_3d" / kind))
    for place in _subfolders(root / "data_rotation"):
        for number, path in enumerate(_subfolders(place)):
            results = root / "results_rotation"
            scenes.append(_scene(root, "rotation", f"{place.name}/{path.name}", path, results, pose=f"P{number}"))
    return tuple(scenes)


def _scene(root: Path, kind: Kind, name: str, folder: Path, results: Path, pose: str = "") -> PaperScene:
    folders = {role: folder / name for role, name in _PICTURES.items() if (folder / name).is_dir()}
    files = {role: folder / name for role, name in _FILES.items() if (folder / name).is_file()}
    thing, _, background = name.partition("_in_")
    captures = root / "data_3d" / "synthetic" / "scenes"
    for role, path in {
        "source_capture": captures / "objects" / thing,
        "target_capture": captures / "backgrounds" / background,
    }.items():
        if background and path.is_dir():
            files[role] = path
    shown = {published_name(method.name): method / name for method in _subfolders(results) if (method / name).is_dir()}
    return PaperScene(name.replace("/", "_"), kind, pose, folders, files, shown)


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

    Pictures are matched by name, or by order if they are numbered, as by 3DGS's render.py, and their number is that of
    all views or of the held-out views. The result is empty if neither fits.
    """
    if same := {stem: found[stem] for stem in wanted if stem in found}:
        return same, f"{len(same)} of {len(wanted)} views by name"
    paths = list(found.values())
    numbered = all(stem.isdigit() for stem in found)
    for views, what in ((list(wanted), "all"), (held_out_stems(wanted), "the held-out")):
        if numbered and len(paths) == len(views):
            return dict(zip(views, paths, strict=True)), f"{what} {len(views)} views by order, as pictures are numbered"
    return {}, f"none of {len(found)} pictures fits {len(wanted)} views, neither by name nor by number"


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def _in_order(name: str) -> list[tuple[int, str | int]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", Path(name).stem)]
