"""project.toml: one table per capture and per step; the keys of a table are the options of the command."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from splatgraft.formats import is_scene
from splatgraft.project.layout import SIDES, Side
from splatgraft.runtime.settings import Table, from_table, path_beside, read_toml

T = TypeVar("T")

TEMPLATE = """\
# A splatgraft project: `splatgraft run` does what is stale, `splatgraft status` says what that is.
# Paths are relative to this file. Every table but the first two may be left out; keys are the options of the command
# of the same name (splatgraft reconstruct --help), with _ for -. `splatgraft init --full` lists every key.

[source]
# photos, a video, a COLMAP folder or a folder with transforms.json; masks are in masks/ beside images/
# or, beside it or instead of it, a trained scene (.ply, .spz, .splat, .sog, .glb, .ksplat); alone, pictures are made:
# scene = "trained.ply"
{source}

[target]
{target}

# [target.reconstruct]       # for one capture alone; [reconstruct] is for both, but a source is a draft unless
# iterations = 7000          # [source.reconstruct] says otherwise: the object is fitted again by itself

# [reconstruct]
# iterations = 3000
# budget = 40000             # maximum number of Gaussians
# eval = true                # hold out every 8th view and measure how well it is predicted

# [segment]
# masks = "masks"            # if they are not beside the images
# prompts = "prompts.toml"   # without masks: points on and beside the object in two or three images
# box = [-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]    # or a box around it, in the source's world

# [compose]                  # not used if there is a placement.json beside this file
# point = [0.0, 0.0, 0.0]    # rest the object on the surface below or above this point of the target
# on = "IMG_0031.jpg:1210,840"               # or on what an image of the target shows at this pixel

# [harmonize]
# method = "none"

# [render]
# eval = true                # keep every 8th view of the target from all later steps, for [evaluate]

# [evaluate]
# ground_truth = "truth"     # images of the target's views with the object really there
"""


@dataclass(frozen=True)
class ProjectFile:
    """The content of a project.toml."""

    path: Path
    """The file, for messages and as the base of relative paths."""
    content: Mapping[str, Any]
    """The tables as read; tables are known, keys not yet checked."""

    def step(self, kind: type[T], given: Mapping[str, Path] | None = None, *, out: Path, side: Side | None = None) -> T:
        """Build the step `kind` from its table, which has the class's name in lower case.

        Paths in the table replace the default paths in `given`, by field; the table of `side` takes precedence. A
        source whose object is fitted again is a draft unless its own table gives a quality.
        """
        name = kind.__name__.lower()
        values, where = dict(self.content.get(name, {})), f"{self.path} [{name}]"
        if side is not None:
            own = self.content[side]
            is_capture = name == "capture"
            if side == "source" and name == "reconstruct" and self._object_is_fitted:
                values |= {"quality": "draft"}
            values |= self._of_capture(side) if is_capture else own.get(name, {})
            where = f"{self.path} [{side}]" if is_capture else where
        # paths in the table replace default inputs, but not the folder of the result
        layout = {key: path for key, path in (given or {}).items() if key not in values} | {"out": out}
        return from_table(kind, Table(values, where, self.path.parent), layout)

    @property
    def _object_is_fitted(self) -> bool:
        """Whether `segment` fits the object to its photographs again; it is then more detailed, and sooner ready, than
        after a finer reconstruction of the whole capture (docs/results.md)."""
        segment = self.content.get("segment", {})
        return segment.get("mask_source") != "box" and segment.get("solidify") != 0

    def scene(self, side: Side) -> Path | None:
        """Return the path of a side's trained scene, None if the file names none."""
        found = self.content[side].get("scene")
        return None if found is None else path_beside(self.path.parent, found)

    def _of_capture(self, side: Side) -> dict[str, Any]:
        """Return the keys of [source] or [target] that are options of `capture`; `scene` replaces `capture`."""
        own = {key: value for key, value in self.content[side].items() if not isinstance(value, dict)}
        scene = own.pop("scene", None)
        return own if scene is None else {"capture": scene} | own


def read_project_file(path: Path, *, tables: tuple[str, ...]) -> ProjectFile:
    """Read project.toml; `tables` are allowed beside [source] and [target]."""
    content = read_toml(path)
    known = (*SIDES, *tables)
    for name, table in content.items():
        if name not in known:
            raise ValueError(f"{path}: expected tables among {', '.join(known)}; found {name}")
        if not isinstance(table, dict):
            raise ValueError(f"{path}: expected [{name}] to be a table, found {table!r}")
    for side in SIDES:
        _check_side(path, side, content.get(side, {}))
        if inner := [k for k, v in content[side].items() if isinstance(v, dict) and k != "reconstruct"]:
            raise ValueError(f"{path}: expected no table in [{side}] but [{side}.reconstruct], found {inner[0]}")
    return ProjectFile(path, content)


def _check_side(path: Path, side: Side, table: Mapping[str, Any]) -> None:
    for key in ("capture", "scene"):
        if key in table and not isinstance(table[key], str):
            raise ValueError(f"{path} [{side}] {key}: expected a path, found {table[key]!r}")
    if "capture" not in table and "scene" not in table:
        raise ValueError(f"{path} [{side}]: expected the key capture (or scene) with a path, found none")
    if is_scene(Path(table.get("capture", ""))):
        raise ValueError(f"{path} [{side}] capture: expected photographs, found a scene; write scene = instead")
    if "scene" in table and "reconstruct" in table:
        raise ValueError(f"{path} [{side}.reconstruct]: expected none beside a trained scene, found one")
