"""The edits of a project as an immutable value, its limits, and its files.

The files are project.toml, placement.json, erased.npy, corrections.npy, prompts.json and light.json.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Int8
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt
from splatgraft.project.gaussian_flags import read_corrections, write_flags
from splatgraft.project.layout import ERASED_FILE, LIGHT_FILE, PLACEMENT_FILE
from splatgraft.project.placement import ObjectPlacement, Placement, read_placement, write_placement
from splatgraft.project.prompts import read_prompts, write_prompts
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights, Light, light_to_json
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.settings import read_toml
from splatgraft.steps.relight import Relight
from splatgraft.steps.segment import Segment
from splatgraft.workflow.flow import read_flow

BoxNumbers = tuple[float, float, float, float, float, float]
Stamp = tuple[int, int]

_SCALES = (1e-6, 1e6)
"""Range of an object's scale; beyond it covariances leave the range of float32."""
_COORDINATES = (-1e6, 1e6)
"""World units; beyond, the resolution of float32 is coarser than about 0.1."""
_HEIGHTS_CM = (1e-3, 1e7)
"""Heights that can be typed: from a hundredth of a millimetre to a hundred kilometres."""
_CORRECTIONS_FILE, _PROMPTS_FILE = "corrections.npy", "prompts.json"
_PLAIN_KEYS = ("mask_source", "keep", "box")  # of [segment], fields of the state of the same name
_KEYS_OF_FILES = {"corrections": "corrections", "prompts": "prompts", "given_light": "light"}
"""Keys of project.toml that name a file, with the field that it holds."""


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
    """Rule for keeping connected pieces of the selection: `keep` of [segment]."""
    prompts: Mapping[str, ViewPrompt] | None = None
    """Points and rectangles in photos of the source, by the photo's name: `prompts` of [segment]."""
    light: Light | None = None
    """The light set by hand; None: it is estimated."""
    weights: LayerWeights = field(default_factory=LayerWeights)
    """Strength of each layer of the light transfer."""
    harmonizer: str | None = None
    """Name of the harmonisation method."""

    def with_object(self, index: int, item: ObjectPlacement) -> "EditState":
        """Return the state with one object replaced."""
        assert self.objects is not None
        return replace(self, objects=(*self.objects[:index], item, *self.objects[index + 1 :]))


def check_state(state: EditState) -> None:
    """Check the numbers that a user types or drags, so that the project stays readable.

    Raise ValueError in one line.
    """
    for index, item in enumerate(state.objects or ()):
        where, move = f"{PLACEMENT_FILE}: object {index + 1}", item.target_from_object
        _check_number(move.scale, f"{where}: scale", _SCALES)
        _check_coordinates(move.translation.tolist(), f"{where}: position")
    if state.box is not None:
        _check_coordinates(state.box, "box")
        # in float32, as the box is used
        lower, upper = torch.tensor(state.box[:3]), torch.tensor(state.box[3:])
        if not bool((lower < upper).all()):
            raise ValueError(f"box: expected lower < upper, found {list(state.box[:3])} and {list(state.box[3:])}")


def _check_coordinates(values: Iterable[float], where: str) -> None:
    for value in values:
        _check_number(value, where, _COORDINATES)


def check_height_cm(value: float) -> None:
    """Check a typed height in centimetres, as `check_state` does."""
    _check_number(value, "height in cm", _HEIGHTS_CM)


def _check_number(value: float, where: str, bounds: tuple[float, float]) -> None:
    # NaN fails the comparison
    if not bounds[0] <= value <= bounds[1]:
        raise ValueError(f"{where}: expected a number from {bounds[0]:g} to {bounds[1]:g}, found {value!r:.60}")


def read_state(project: Path) -> EditState:
    """Read the state from project.toml and the files beside it; raise ValueError, in one line, for an invalid file."""
    content, flow, placement = read_toml(project), read_flow(project), project.parent / PLACEMENT_FILE
    segment, relight = flow.typed(Segment), flow.typed(Relight)
    values: dict[str, Any] = {key: getattr(segment, key) for key in _PLAIN_KEYS if key in content.get("segment", {})}
    if placement.is_file():
        found = read_placement(placement)
        values |= {"objects": found.objects, "erased": found.erased}
    state = EditState(
        corrections=None if segment.corrections is None else read_corrections(segment.corrections),
        prompts=None if segment.prompts is None else read_prompts(segment.prompts),
        light=relight.given(),
        weights=relight.weights,
        harmonizer=content.get("harmonize", {}).get("method"),
        **values,
    )
    check_state(state)
    return state


def write_state(project: Path, before: EditState, after: EditState) -> None:
    """Update the files from state `before` to state `after`; equal parts stay untouched.

    Files are written before project.toml, which must not refer to a missing file. Raise ValueError if project.toml
    cannot be changed line by line.
    """

    def is_new(name: str) -> bool:
        return getattr(after, name) is not getattr(before, name)

    folder, old = project.parent, project.read_text(encoding="utf-8")
    text, new_keys, old_keys = old, _keys(after), _keys(before)
    for (table, key), value in new_keys.items():
        # the file of a changed field may have another name, set by hand
        is_file = key in _KEYS_OF_FILES and is_new(_KEYS_OF_FILES[key])
        if is_file or json.dumps(value) != json.dumps(old_keys[table, key]):
            text = with_keys(text, table, {key: value})
    if after.corrections is not None and is_new("corrections"):
        write_flags(folder / _CORRECTIONS_FILE, after.corrections)
    if after.prompts is not None and is_new("prompts"):
        write_prompts(folder / _PROMPTS_FILE, after.prompts)
    if after.light is not None and is_new("light"):
        with atomic_write(folder / LIGHT_FILE) as stream:
            stream.write(light_to_json(after.light).encode())
    if is_new("objects") or is_new("erased"):
        if after.objects is None:
            (folder / PLACEMENT_FILE).unlink(missing_ok=True)
        else:
            write_placement(folder / PLACEMENT_FILE, Placement(objects=after.objects, erased=after.erased))
        if after.objects is None or after.erased is None:
            (folder / ERASED_FILE).unlink(missing_ok=True)
    if text != old:
        with atomic_write(project) as stream:
            stream.write(text.encode())


def state_files(project: Path) -> tuple[Path, ...]:
    """Return all files that hold the state."""
    names = (PLACEMENT_FILE, ERASED_FILE, _CORRECTIONS_FILE, _PROMPTS_FILE, LIGHT_FILE)
    return (project, *(project.parent / name for name in names))


def stamps_of(project: Path) -> tuple[Stamp, ...]:
    """Return the current stamps of these files."""
    return tuple(map(stamp_of, state_files(project)))


def stamp_of(path: Path) -> Stamp:
    """Return time and size of a file; zeros if it does not exist."""
    return (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else (0, 0)


def _keys(state: EditState) -> dict[tuple[str, str], Any]:
    """Return all keys of the editor by table and name."""
    segment = {
        "mask_source": state.mask_source,
        "box": state.box,
        "keep": state.keep,
        "corrections": None if state.corrections is None else _CORRECTIONS_FILE,
        "prompts": None if state.prompts is None else _PROMPTS_FILE,
    }
    # a default, which is physically correct, needs no key
    usual = asdict(LayerWeights())
    relight = {key: None if value == usual[key] else value for key, value in asdict(state.weights).items()}
    relight["given_light"] = None if state.light is None else LIGHT_FILE
    tables = {"segment": segment, "relight": relight, "harmonize": {"method": state.harmonizer}}
    return {(table, key): value for table, keys in tables.items() for key, value in keys.items()}
