"""The edits in their files: project.toml, placement.json, erased.npy, corrections.npy, prompts.json, light.json."""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from splatgraft.editor.state import BoxNumbers, EditState, check_state
from splatgraft.project.gaussian_flags import read_corrections, write_flags
from splatgraft.project.layout import ERASED_FILE, LIGHT_FILE, PLACEMENT_FILE
from splatgraft.project.placement import Placement, read_placement, write_placement
from splatgraft.project.prompts import read_prompts, write_prompts
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights, Light, light_from_json, light_to_json
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.settings import MAX_TEXT_BYTES, read_toml

Stamps = tuple[tuple[int, int] | None, ...]
"""Time and size of each file of the edits; None for a missing file."""
_CORRECTIONS_FILE, _PROMPTS_FILE = "corrections.npy", "prompts.json"
_KEYS_OF_FILES = {"corrections": "corrections", "prompts": "prompts", "given_light": "light"}
"""Keys of project.toml that name a file, with the field that it holds."""


def read_state(project: Path) -> EditState:
    """Read the state from project.toml and the files beside it; raise ValueError, in one line, for an invalid file."""
    content, folder = read_toml(project), project.parent
    segment, relight, harmonize = (_table(content, name, project) for name in ("segment", "relight", "harmonize"))
    placement, file = folder / PLACEMENT_FILE, project
    given, corrections, prompts = relight.get("given_light"), segment.get("corrections"), segment.get("prompts")
    values: dict[str, Any] = {}
    # a file may hold numbers beyond float's range, a path of the wrong type, or endless nesting
    try:
        values |= {key: segment[key] for key in ("mask_source", "keep") if key in segment}
        values |= {"box": _six(segment["box"], project)} if "box" in segment else {}
        values |= {"weights": _weights(relight, project), "harmonizer": harmonize.get("method")}
        if corrections is not None:
            values["corrections"] = read_corrections(folder / corrections)
        if prompts is not None:
            values["prompts"] = read_prompts(folder / prompts)
        if given is not None:
            values["light"] = _light(folder / given)
        check_state(EditState(**values))
        if placement.is_file():
            file = placement
            _check_size(placement)
            found = read_placement(placement)
            values |= {"objects": found.objects, "erased": found.erased}
            check_state(EditState(objects=found.objects))
    except (ValueError, OSError, TypeError, ArithmeticError, RecursionError, MemoryError) as error:
        line = " ".join((str(error) or type(error).__name__).split())
        raise ValueError(line if str(folder) in line else f"{file}: {line}") from error
    return EditState(**values)


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


def as_written(state: EditState, before: EditState) -> EditState:
    """Round the light to six digits, as light.json does; a light shared with `before` stays identical."""
    if state.light is None or state.light is before.light:
        return state
    return replace(state, light=light_from_json(light_to_json(state.light)))


def state_files(project: Path) -> tuple[Path, ...]:
    """Return all files that hold the state."""
    names = (PLACEMENT_FILE, ERASED_FILE, _CORRECTIONS_FILE, _PROMPTS_FILE, LIGHT_FILE)
    return (project, *(project.parent / name for name in names))


def stamps_of(project: Path) -> Stamps:
    """Return the current stamps of these files."""
    return tuple((p.stat().st_mtime_ns, p.stat().st_size) if p.is_file() else None for p in state_files(project))


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


def _table(content: Mapping[str, Any], name: str, project: Path) -> Mapping[str, Any]:
    table = content.get(name, {})
    if not isinstance(table, dict):
        raise ValueError(f"{project}: expected [{name}] to be a table, found {table!r:.60}")
    return table


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
