"""The edits in their files: project.toml, placement.json, erased.npy, corrections.npy, prompts.json, light.json."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from splatgraft.editor.state import EditState, check_state
from splatgraft.project.gaussian_flags import read_corrections, write_flags
from splatgraft.project.layout import ERASED_FILE, LIGHT_FILE, PLACEMENT_FILE
from splatgraft.project.placement import Placement, read_placement, write_placement
from splatgraft.project.prompts import read_prompts, write_prompts
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights, light_from_json, light_to_json
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.settings import MAX_TEXT_BYTES, read_toml
from splatgraft.steps.relight import Relight
from splatgraft.steps.segment import Segment
from splatgraft.workflow.flow import read_flow

Stamps = tuple[tuple[int, int] | None, ...]
"""Time and size of each file of the edits; None for a missing file."""
_CORRECTIONS_FILE, _PROMPTS_FILE = "corrections.npy", "prompts.json"
_PLAIN_KEYS = ("mask_source", "keep", "box")  # of [segment], fields of the state of the same name
_KEYS_OF_FILES = {"corrections": "corrections", "prompts": "prompts", "given_light": "light"}
"""Keys of project.toml that name a file, with the field that it holds."""


def read_state(project: Path) -> EditState:
    """Read the state from project.toml and the files beside it; raise ValueError, in one line, for an invalid file."""
    content, steps, file = read_toml(project), read_flow(project).steps, project
    segment, relight, placement = steps["segment"], steps["relight"], project.parent / PLACEMENT_FILE
    assert isinstance(segment, Segment)
    assert isinstance(relight, Relight)
    # a file may hold numbers beyond float's range, a path of the wrong type, or endless nesting
    try:
        values: dict[str, Any] = {
            key: getattr(segment, key) for key in _PLAIN_KEYS if key in content.get("segment", {})
        }
        values |= {"weights": relight.weights, "harmonizer": content.get("harmonize", {}).get("method")}
        if segment.corrections is not None:
            values["corrections"] = read_corrections(segment.corrections)
        if segment.prompts is not None:
            values["prompts"] = read_prompts(segment.prompts)
        if relight.given_light is not None:
            _check_size(relight.given_light)
            values["light"] = relight.given()
        check_state(EditState(**values))
        if placement.is_file():
            file = placement
            _check_size(placement)
            found = read_placement(placement)
            values |= {"objects": found.objects, "erased": found.erased}
            check_state(EditState(objects=found.objects))
    except (ValueError, OSError, TypeError, ArithmeticError, RecursionError, MemoryError) as error:
        line = " ".join((str(error) or type(error).__name__).split())
        raise ValueError(line if str(project.parent) in line else f"{file}: {line}") from error
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


def _check_size(path: Path) -> None:
    size = path.stat().st_size if path.is_file() else 0
    if size > MAX_TEXT_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_TEXT_BYTES >> 20} MiB of text, found {size >> 20} MiB")
