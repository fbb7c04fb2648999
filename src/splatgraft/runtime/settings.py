"""Frozen dataclasses built from TOML tables, with one-line errors that name the file and the key.

msgspec would convert the values, but its errors name no choices, and of most wrong values only the type.
"""

import json
import math
import os
import tomllib
import types
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")

MAX_TEXT_BYTES = 16 << 20
"""Maximum size of a settings file; a larger one is another kind of file with that name."""
_LARGEST_INT = 2**63  # TOML's integers have 64 bits


@dataclass(frozen=True)
class Table:
    """One table of a TOML file."""

    values: Mapping[str, Any]
    """Keys and values as read."""
    where: str
    """File and name of the table, for messages."""
    folder: Path
    """Base folder of the table's relative paths."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raises ValueError if it is missing or not TOML."""
    if path.is_file() and path.stat().st_size > MAX_TEXT_BYTES:
        size = path.stat().st_size >> 20
        raise ValueError(f"{path}: expected at most {MAX_TEXT_BYTES >> 20} MiB of TOML, found {size} MiB")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: expected a TOML file, found none") from error
    except RecursionError as error:
        raise ValueError(f"{path}: expected TOML, found values nested too deeply") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path}: expected TOML, found {type(error).__name__}: {error}") from error


def from_table(kind: type[T], table: Table, given: Mapping[str, Any]) -> T:
    """Build a `kind` from `given` values, keys of the table and defaults, in this order of precedence.

    The fields of nested dataclasses are keys of the same table. A field whose type is a union of dataclasses, each with
    a class variable `name`, is a key whose value is one of these names; the fields of that class are further keys.

    Raises:
        ValueError: A key is unknown or missing, or a value has the wrong type.
    """
    known = _keys(kind, table) - set(given)
    if unknown := sorted(set(table.values) - known):
        chosen = [f" with {key} = {json.dumps(value.name)}" for key, value in _choices(kind, table).items()]
        expected = f"expected keys among {', '.join(sorted(known))}{''.join(chosen)}"
        raise ValueError(f"{table.where}: {expected}; found {', '.join(unknown)}")
    return _build(kind, table, given)


@cache
def field_types(kind: type) -> dict[str, Any]:
    """Return the type of each field of a dataclass, without the annotations for tyro."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: _bare(hints[field.name]) for field in fields(kind)}


def choices(hint: Any) -> dict[str, Any]:
    """Return the dataclasses of a union of named dataclasses, by name; nothing for any other type."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else ()
    return {kind.name: kind for kind in kinds} if all(map(is_dataclass, kinds)) else {}


def _bare(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        return _bare(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        return Union[tuple(_bare(each) for each in get_args(hint))]  # noqa: UP007
    return hint


def _choices(kind: type, table: Table) -> dict[str, Any]:
    """Return the dataclass chosen by the table, or else by the default, for each field with a choice."""
    found: dict[str, Any] = {}
    for field in fields(kind):
        if named := choices(field_types(kind)[field.name]):
            name = table.values.get(field.name, getattr(default_of(field), "name", None))
            if name not in named:
                wanted = ", ".join(sorted(named))
                raise ValueError(f"{table.where} {field.name}: expected one of {wanted}; found {name!r}")
            found[field.name] = named[name]
    return found


def _keys(kind: type, table: Table) -> set[str]:
    hints, chosen = field_types(kind), _choices(kind, table)
    nested: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    return (set(hints) - set(nested)).union(*(_keys(inner, table) for inner in (*nested.values(), *chosen.values())))


def default_of(field: "Field[Any]") -> Any:
    """Return the default of a field, `MISSING` if it has none."""
    return field.default_factory() if field.default_factory is not MISSING else field.default


def _build(kind: type[T], table: Table, given: Mapping[str, Any]) -> T:
    values: dict[str, Any] = {}
    chosen_kinds = _choices(kind, table)
    for field in fields(kind):  # pyright: ignore[reportArgumentType]
        hint = field_types(kind)[field.name]
        if field.name in given:
            values[field.name] = given[field.name]
        elif field.name in chosen_kinds:
            values[field.name] = _build(chosen_kinds[field.name], table, {})
        elif is_dataclass(hint):
            nested = field.default_factory() if field.default_factory is not MISSING else None
            # keys that the table does not set keep the outer class's choice for the inner one
            inner = field_types(type(nested)) if nested else {}
            keys = {key for key, kept in inner.items() if not is_dataclass(kept)} - set(table.values)
            values[field.name] = _build(hint, table, {key: getattr(nested, key) for key in keys})  # pyright: ignore
        elif field.name in table.values:
            values[field.name] = _convert(table.values[field.name], hint, table, field.name)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{table.where}: expected the key {field.name}, found none")
    return kind(**values)


def path_beside(folder: Path, text: str) -> Path:
    """Resolve a path named in a file in `folder`, without unnecessary steps up (..), for plain messages."""
    path = folder / Path(text).expanduser()
    plain = Path(os.path.normpath(path))
    # after a symbolic link, a step up leads to another folder
    return plain if path.exists() and plain.exists() and plain.samefile(path) else path


def _convert(value: Any, hint: Any, table: Table, key: str) -> Any:
    """Convert `value` to the type `hint`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _convert_any(value, [a for a in arguments if a is not types.NoneType], table, key)
    if origin is tuple and isinstance(value, list):
        kinds = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        if len(kinds) == len(value):
            return tuple(_convert(v, kind, table, key) for v, kind in zip(value, kinds, strict=True))
    if hint is Path and isinstance(value, str):
        return path_beside(table.folder, value)
    if hint is float and type(value) is int and abs(value) < _LARGEST_INT:
        return float(value)
    if hint is float and type(value) is float and math.isnan(value):
        raise ValueError(f"{table.where} {key}: expected a number, found nan")
    if (origin is Literal and value in arguments) or (hint in (int, float, str, bool) and type(value) is hint):
        return value
    wanted = " or ".join(map(repr, arguments)) if origin is Literal else getattr(hint, "__name__", str(hint))
    raise ValueError(f"{table.where} {key}: expected {str(hint) if origin is tuple else wanted}, found {value!r:.60}")


def _convert_any(value: Any, hints: list[Any], table: Table, key: str) -> Any:
    """Convert `value` to the first type that accepts it."""
    for hint in hints[:-1]:
        try:
            return _convert(value, hint, table, key)
        except ValueError:
            continue
    return _convert(value, hints[-1], table, key)
