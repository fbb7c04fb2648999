"""The edits of a project in its files: project.toml, placement.json, erased.npy, corrections.npy, prompts.json and
light.json."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from splatgraft.editor.session.edit_state import BoxNumbers, EditState
from splatgraft.editor.session.state_checks import check_state
from splatgraft.editor.session.toml_edit import with_keys
from splatgraft.formats.gaussian_flags import read_corrections, write_flags
from splatgraft.formats.placement import Placement, read_placement, write_placement
from splatgraft.formats.prompts import read_prompts, write_prompts
from splatgraft.project.layout import ERASED_FILE, LIGHT_FILE, PLACEMENT_FILE
from splatgraft.relighting import LayerWeights, Light, light_from_json, light_to_json
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.settings import MAX_TEXT_BYTES, read_toml

_PARTS = {"objects": ("objects", "erased")}
"""Fields of the state that are read together: placement.json names erased.npy."""
CORRECTIONS_FILE, PROMPTS_FILE = "corrections.npy", "prompts.json"
_FILES = {
    "objects": PLACEMENT_FILE,
    "corrections": CORRECTIONS_FILE,
    "prompts": PROMPTS_FILE,
    "light": LIGHT_FILE,
}
"""Usual file of a field of the state; project.toml holds the others."""


@dataclass(frozen=True)
class FoundState:
    """What project.toml and the files beside it hold."""

    state: EditState
    """The edits; what could not be read is as in a project without it."""
    problems: Mapping[str, str]
    """One line for each field of the state that could not be read."""


def read_state(project: Path) -> EditState:
    """Read the state from project.toml and the files beside it.

    Raises:
        ValueError: If one of these files is invalid.
    """
    found = find_state(project)
    for problem in found.problems.values():
        raise ValueError(problem)
    return found.state


def find_state(project: Path) -> FoundState:
    """Read what can be read of the state.

    Raises:
        ValueError: If project.toml is no TOML, or one of its tables is none.
    """
    content, folder = read_toml(project), project.parent
    segment, relight, harmonize = (_table(content, name, project) for name in ("segment", "relight", "harmonize"))
    placement = folder / PLACEMENT_FILE
    given, corrections, prompts = relight.get("given_light"), segment.get("corrections"), segment.get("prompts")
    readers: dict[str, Callable[[], EditState]] = {
        "objects": lambda: _placed(placement) if placement.is_file() else EditState(),
        "corrections": lambda: EditState(
            corrections=None if corrections is None else read_corrections(folder / corrections)
        ),
        "mask_source": lambda: EditState(mask_source=segment.get("mask_source")),
        "box": lambda: EditState(box=None if "box" not in segment else _six(segment["box"], project)),
        "keep": lambda: EditState(keep=segment.get("keep")),
        "prompts": lambda: EditState(prompts=None if prompts is None else read_prompts(folder / prompts)),
        "light": lambda: EditState(light=None if given is None else _light(folder / given)),
        "weights": lambda: EditState(weights=_weights(relight, project)),
        "harmonizer": lambda: EditState(harmonizer=harmonize.get("method")),
    }
    values: dict[str, Any] = {}
    problems: dict[str, str] = {}
    for name, read in readers.items():
        try:
            part = read()
            check_state(part)
        # a file may hold anything: numbers beyond float's range, a path of the wrong type, nesting without end
        except (ValueError, OSError, TypeError, ArithmeticError, RecursionError, MemoryError) as error:
            file = folder / _FILES[name] if name in _FILES else project
            problems[name] = _named(str(error) or type(error).__name__, file)
            continue
        values |= {f.name: getattr(part, f.name) for f in fields(part) if f.name in _PARTS.get(name, (name,))}
    return FoundState(EditState(**values), problems)


def write_state(project: Path, before: EditState | None, after: EditState) -> None:
    """Update the files from state `before` to state `after`; what both agree on stays untouched.

    Files that project.toml refers to are written before it, so that it never refers to a missing file.

    Args:
        project: project.toml.
        before: What the files hold; None where that is not known, and then all is written.
        after: What they shall hold.

    Raises:
        ValueError: If project.toml cannot be changed line by line.
    """
    folder = project.parent
    text = project.read_text(encoding="utf-8")
    for table, keys in _changed_keys(before, after).items():
        text = with_keys(text, table, keys)
    if after.corrections is not None and (before is None or after.corrections is not before.corrections):
        write_flags(folder / CORRECTIONS_FILE, after.corrections)
    if after.prompts is not None and (before is None or after.prompts is not before.prompts):
        write_prompts(folder / PROMPTS_FILE, after.prompts)
    if after.light is not None and (before is None or after.light is not before.light):
        with atomic_write(folder / LIGHT_FILE) as stream:
            stream.write(light_to_json(after.light).encode())
    if before is None or after.objects is not before.objects or after.erased is not before.erased:
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
    names = (PLACEMENT_FILE, ERASED_FILE, CORRECTIONS_FILE, PROMPTS_FILE, LIGHT_FILE)
    return (project, *(project.parent / name for name in names))


def _write_placement(path: Path, state: EditState) -> None:
    if state.objects is None:
        path.unlink(missing_ok=True)
    else:
        write_placement(path, Placement(objects=state.objects, erased=state.erased))
    if state.objects is None or state.erased is None:
        (path.parent / ERASED_FILE).unlink(missing_ok=True)


def _changed_keys(before: EditState | None, after: EditState) -> dict[str, Mapping[str, Any]]:
    tables = ((_segment_keys, "segment"), (_relight_keys, "relight"), (_harmonize_keys, "harmonize"))
    # the file of what was changed may have another name, given by hand
    renewed = {
        key
        for key, field in (("corrections", "corrections"), ("prompts", "prompts"), ("given_light", "light"))
        if before is not None and getattr(after, field) is not getattr(before, field)
    }
    changes: dict[str, Mapping[str, Any]] = {}
    for keys_of, table in tables:
        new, old = keys_of(after), {} if before is None else keys_of(before)
        changed = {
            key: new[key]
            for key in new
            if key not in old or key in renewed or json.dumps(new[key]) != json.dumps(old[key])
        }
        changes |= {table: changed} if changed else {}
    return changes


def _segment_keys(state: EditState) -> dict[str, Any]:
    corrections = None if state.corrections is None else CORRECTIONS_FILE
    prompts = None if state.prompts is None else PROMPTS_FILE
    keys = {"mask_source": state.mask_source, "box": state.box, "keep": state.keep}
    return keys | {"corrections": corrections, "prompts": prompts}


def _relight_keys(state: EditState) -> dict[str, Any]:
    # what is physically right is the default and needs no key
    usual = asdict(LayerWeights())
    weights = {key: None if value == usual[key] else value for key, value in asdict(state.weights).items()}
    return weights | {"given_light": None if state.light is None else LIGHT_FILE}


def _harmonize_keys(state: EditState) -> dict[str, Any]:
    return {"method": state.harmonizer}


def _table(content: Mapping[str, Any], name: str, project: Path) -> Mapping[str, Any]:
    table = content.get(name, {})
    if not isinstance(table, dict):
        raise ValueError(f"{project}: expected [{name}] to be a table, found {table!r:.60}")
    return table


def _placed(path: Path) -> EditState:
    _check_size(path)
    found = read_placement(path)
    return EditState(objects=found.objects, erased=found.erased)


def _light(path: Path) -> Light:
    if not path.is_file():
        raise ValueError(f"{path}: expected a light.json, found no such file")
    _check_size(path)
    return light_from_json(path.read_text(encoding="utf-8"), name=str(path))


def _weights(relight: Mapping[str, Any], project: Path) -> LayerWeights:
    given = {f.name: relight[f.name] for f in fields(LayerWeights) if f.name in relight}
    for name, value in given.items():
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise ValueError(f"{project} [relight] {name}: expected a number, found {value!r:.60}")
    return LayerWeights(**{name: float(value) for name, value in given.items()})


def _six(box: Any, project: Path) -> BoxNumbers:
    if not isinstance(box, list) or len(box) != 6 or not all(isinstance(x, int | float) for x in box):
        raise ValueError(f"{project} [segment] box: expected six numbers, found {box!r:.60}")
    a, b, c, d, e, f = (float(x) for x in box)
    return a, b, c, d, e, f


def _check_size(path: Path) -> None:
    size = path.stat().st_size
    if size > MAX_TEXT_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_TEXT_BYTES >> 20} MiB of text, found {size >> 20} MiB")


def _named(message: str, file: Path) -> str:
    """The message in one line, with the file's name in it."""
    line = " ".join(message.split())
    return line if str(file.parent) in line else f"{file}: {line}"
