"""Which scenes a published data set has and what their folders hold: guessed, said, and overridden by layout.toml.

Every guess is a sentence in `PaperScene.taken`, and `as_toml` writes all of them in the form in which they can be
corrected.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatgraft.runtime.settings import read_toml
from splatgraft_paper.tables.dot3d_folders import find_dot3d
from splatgraft_paper.tables.paper_numbers import published_name
from splatgraft_paper.tables.paper_scene import LAYOUT_FILE, DataLayout, Dataset, PaperScene, from_root
from splatgraft_paper.tables.picture_folders import ROLES
from splatgraft_paper.tables.syncom_folders import find_syncom

_FIND = {"dot3d": find_dot3d, "syncom": find_syncom}
_HELD_OUT_EVERY = {"dot3d": 8, "syncom": 1}
_FILES = ("target_scene", "object_scene", "cameras", "placement", "source_capture", "target_capture")
"""Keys of layout.toml for a scene beside those of its pictures."""


def find_layout(folder: Path, overrides: Path | None = None, *, dataset: Dataset = "dot3d") -> DataLayout:
    """Find the scenes of a data set and what their folders hold.

    Args:
        folder: The data set, or the folder that dot3d_data/ lies in.
        overrides: A layout.toml; `folder`/layout.toml where there is one and none is given.
        dataset: Whose folders they are: the authors' (dot3d), or those of ComGS (syncom).

    Raises:
        ValueError: No folder of the card is there, or the layout.toml names something that is not.
    """
    root, scenes = _FIND[dataset](folder)
    given = overrides or (folder / LAYOUT_FILE)
    table = read_toml(given) if overrides is not None or given.is_file() else {}
    _check_keys(table, given, scenes)
    return DataLayout(
        root=root,
        scenes=tuple(_overridden(scene, table, given, root) for scene in scenes),
        held_out_every=int(table.get("held_out_every", _HELD_OUT_EVERY[dataset])),
        dataset=dataset,
    )


def as_toml(layout: DataLayout) -> str:
    """Format everything that was found as a layout.toml, with the reasons as comments."""
    lines = [f"held_out_every = {layout.held_out_every}"]
    for scene in layout.scenes:
        lines += ["", *(f"# {sentence}" for sentence in scene.taken), f"[scenes.{json.dumps(scene.name)}]"]
        if scene.pose:
            lines.append(f"pose = {json.dumps(scene.pose)}")
        for key, path in (*scene.folders.items(), *scene.files.items()):
            lines.append(f"{key} = {json.dumps(from_root(path, layout.root))}")
        if scene.results:
            lines.append(f"[scenes.{json.dumps(scene.name)}.results]")
        for method, path in scene.results.items():
            lines.append(f"{json.dumps(method)} = {json.dumps(from_root(path, layout.root))}")
    return "\n".join(lines) + "\n"


def _check_keys(table: Mapping[str, Any], path: Path, scenes: list[PaperScene]) -> None:
    if unknown := sorted(set(table) - {"held_out_every", "scenes"}):
        raise ValueError(f"{path}: expected the keys held_out_every and scenes, found {', '.join(unknown)}")
    known = {"pose", "results", *ROLES, *_FILES}
    names = [scene.name for scene in scenes]
    for name, values in table.get("scenes", {}).items():
        if name not in names:
            raise ValueError(
                f"{path}: [scenes.{name}]: expected a scene among {', '.join(names)}; found none of this name"
            )
        if unknown := sorted(set(values) - known):
            raise ValueError(f"{path}: [scenes.{name}]: expected keys among {', '.join(sorted(known))}; "
                             f"found {', '.join(unknown)}")  # fmt: skip


def _overridden(scene: PaperScene, table: Mapping[str, Any], path: Path, root: Path) -> PaperScene:
    """Replace guesses by what the layout.toml says; an empty text says that there is none."""
    given = table.get("scenes", {}).get(scene.name)
    if given is None:
        return scene
    folders, files, results = dict(scene.folders), dict(scene.files), dict(scene.results)
    for key, value in given.items():
        if key == "results":
            for method, where in value.items():
                _put(results, published_name(method), where, root, path)
        elif key != "pose":
            _put(folders if key in ROLES else files, key, value, root, path)
    said = f"{path}: what it names replaces the guesses ({', '.join(given)})"
    pose = given.get("pose", scene.pose)
    return replace(scene, pose=pose, folders=folders, files=files, results=results, taken=(*scene.taken, said))


def _put(into: dict[str, Path], key: str, value: str, root: Path, path: Path) -> None:
    if value == "":
        into.pop(key, None)
        return
    if not (root / value).exists():
        raise ValueError(f"{path}: expected {key} at {root / value}, found no such file or folder")
    into[key] = root / value
