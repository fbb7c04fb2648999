"""The edits of a project as one immutable value, read from and written to project.toml and the files beside it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from jaxtyping import Bool, Int8
from torch import Tensor

from splatgraft.editor.session.toml_edit import with_keys
from splatgraft.formats.corrections import read_corrections, write_corrections
from splatgraft.formats.placement import ObjectPlacement, Placement, read_placement, write_placement
from splatgraft.project.layout import LIGHT_FILE, PLACEMENT_FILE
from splatgraft.relighting import LayerWeights, Light, light_from_json, light_to_json
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.settings import read_toml

CORRECTIONS_FILE, ERASED_FILE = "corrections.npy", "erased.npy"
BoxNumbers = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class EditState:
    """The current edits. None means that project.toml has no entry and the step's default applies."""

    objects: tuple[ObjectPlacement, ...] | None = None
    """Placed objects; one without a path is the project's own object. None: `compose` finds a place."""
    erased: Bool[Tensor, "n"] | None = None
    """Gaussians of the target that are erased."""
    corrections: Int8[Tensor, "m"] | None = None
    """Per Gaussian of the source: 1 added to the object by hand, -1 removed, 0 unchanged."""
    mask_source: str | None = None
    """Source of the object's masks: `mask_source` of [segment]."""
    box: BoxNumbers | None = None
    """Box around the object in the source's world: minimum x, y, z, then maximum."""
    keep: str | None = None
    """Which connected pieces of the selection are kept: `keep` of [segment]."""
    light: Light | None = None
    """The light set by hand; None: it is estimated."""
    weights: LayerWeights = field(default_factory=LayerWeights)
    """Strength of each layer of the light transfer."""
    harmonizer: str | None = None
    """Name of the harmonisation method."""

    def with_object(self, index: int, item: ObjectPlacement) -> "EditState":
        """The state with another placement of one object."""
        assert self.objects is not None
        return replace(self, objects=(*self.objects[:index], item, *self.objects[index + 1 :]))


def read_state(project: Path) -> EditState:
    """Read the state from project.toml and the files beside it.

    Raises:
        ValueError: If one of these files is invalid.
    """
    content, folder = read_toml(project), project.parent
    segment, relight = content.get("segment", {}), content.get("relight", {})
    placement = folder / PLACEMENT_FILE
    placed = read_placement(placement) if placement.is_file() else None
    given, corrections = relight.get("given_light"), segment.get("corrections")
    light = None if given is None else light_from_json(_text(folder / given), name=str(folder / given))
    weights = {f.name: float(relight[f.name]) for f in fields(LayerWeights) if f.name in relight}
    box = segment.get("box")
    return EditState(
        objects=None if placed is None else placed.objects,
        erased=None if placed is None else placed.erased,
        corrections=None if corrections is None else read_corrections(folder / corrections),
        mask_source=segment.get("mask_source"),
        box=None if box is None else _six(box, project),
        keep=segment.get("keep"),
        light=light,
        weights=LayerWeights(**weights),
        harmonizer=content.get("harmonize", {}).get("method"),
    )


def write_state(project: Path, before: EditState, after: EditState) -> None:
    """Update the files from state `before` to state `after`; what both agree on stays untouched.

    Files that project.toml refers to are written before it, so that it never refers to a missing file.

    Raises:
        ValueError: If project.toml cannot be changed line by line.
    """
    folder = project.parent
    text = project.read_text(encoding="utf-8")
    for table, keys in _changed_keys(before, after).items():
        text = with_keys(text, table, keys)
    if after.corrections is not None and after.corrections is not before.corrections:
        write_corrections(folder / CORRECTIONS_FILE, after.corrections)
    if after.light is not None and after.light is not before.light:
        with atomic_write(folder / LIGHT_FILE) as stream:
            stream.write(light_to_json(after.light).encode())
    if after.objects is not before.objects or after.erased is not before.erased:
        _write_placement(folder / PLACEMENT_FILE, after)
    if text != project.read_text(encoding="utf-8"):
        with atomic_write(project) as stream:
            stream.write(text.encode())


def as_written(state: EditState, before: EditState) -> EditState:
    """The state as it is read back: light.json rounds to six digits. A light shared with `before` stays identical."""
    if state.light is None or state.light is before.light:
        return state
    return replace(state, light=light_from_json(light_to_json(state.light)))


def state_files(project: Path) -> tuple[Path, ...]:
    """All files that hold the state."""
    names = (PLACEMENT_FILE, ERASED_FILE, CORRECTIONS_FILE, LIGHT_FILE)
    return (project, *(project.parent / name for name in names))


def _write_placement(path: Path, state: EditState) -> None:
    if state.objects is None:
        path.unlink(missing_ok=True)
    else:
        write_placement(path, Placement(objects=state.objects, erased=state.erased))
    if state.objects is None or state.erased is None:
        (path.parent / ERASED_FILE).unlink(missing_ok=True)


def _changed_keys(before: EditState, after: EditState) -> dict[str, Mapping[str, Any]]:
    tables = ((_segment_keys, "segment"), (_relight_keys, "relight"), (_harmonize_keys, "harmonize"))
    changes: dict[str, Mapping[str, Any]] = {}
    for keys_of, table in tables:
        old, new = keys_of(before), keys_of(after)
        changed = {key: new[key] for key in new if json.dumps(new[key]) != json.dumps(old[key])}
        changes |= {table: changed} if changed else {}
    return changes


def _segment_keys(state: EditState) -> dict[str, Any]:
    corrections = None if state.corrections is None else CORRECTIONS_FILE
    return {"mask_source": state.mask_source, "box": state.box, "keep": state.keep, "corrections": corrections}


def _relight_keys(state: EditState) -> dict[str, Any]:
    # the physical weight, 1, is the default and needs no key
    weights = {key: None if value == 1.0 else value for key, value in asdict(state.weights).items()}
    return weights | {"given_light": None if state.light is None else LIGHT_FILE}


def _harmonize_keys(state: EditState) -> dict[str, Any]:
    return {"method": state.harmonizer}


def _text(path: Path) -> str:
    if not path.is_file():
        raise ValueError(f"{path}: expected a light.json, found no such file")
    return path.read_text(encoding="utf-8")


def _six(box: Any, project: Path) -> BoxNumbers:
    if not isinstance(box, list) or len(box) != 6 or not all(isinstance(x, int | float) for x in box):
        raise ValueError(f"{project} [segment] box: expected six numbers, found {box!r:.60}")
    a, b, c, d, e, f = (float(x) for x in box)
    return a, b, c, d, e, f
