"""TOML tables become frozen dataclasses; what does not fit is told by file and key. Knows no particular key."""

import tomllib
import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


@dataclass(frozen=True)
class Table:
    """One table of a TOML file."""

    values: Mapping[str, Any]
    """Keys and values as read."""
    where: str
    """For messages: the file and the name of the table."""
    folder: Path
    """What paths in it are relative to."""


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises: ValueError where there is no such file or it is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: expected a TOML file, found none") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path}: expected TOML, found {type(error).__name__}: {error}") from error


def from_table(kind: type[T], table: Table, given: Mapping[str, Any]) -> T:
    """A `kind` whose fields are `given`, or keys of the table, or defaults; nested dataclasses share the same table.

    Raises: ValueError where a key is unknown or missing, or a value has the wrong type.
    """
    known = _keys(kind) - set(given)
    if unknown := sorted(set(table.values) - known):
        raise ValueError(f"{table.where}: expected keys among {', '.join(sorted(known))}; found {', '.join(unknown)}")
    return _build(kind, table, given)


def _keys(kind: type) -> set[str]:
    hints = field_types(kind)
    nested = [name for name, hint in hints.items() if is_dataclass(hint)]
    return (set(hints) - set(nested)).union(*(_keys(hints[name]) for name in nested))


def _build(kind: type[T], table: Table, given: Mapping[str, Any]) -> T:
    values: dict[str, Any] = {}
    for field in fields(kind):  # pyright: ignore[reportArgumentType]
        hint = field_types(kind)[field.name]
        if field.name in given:
            values[field.name] = given[field.name]
        elif is_dataclass(hint):
            nested = field.default_factory() if field.default_factory is not MISSING else None
            # what the outer class chose for the inner one stands where the table is silent
            chosen = {key: getattr(nested, key) for key in _keys(type(nested)) - set(table.values)} if nested else {}
            values[field.name] = _build(hint, table, chosen)  # pyright: ignore[reportArgumentType]
        elif field.name in table.values:
            values[field.name] = _convert(table.values[field.name], hint, table, field.name)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{table.where}: expected the key {field.name}, found none")
    return kind(**values)


def field_types(kind: type) -> dict[str, Any]:
    """The type of each field of a dataclass, without the annotations that tyro reads."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        field.name: get_args(hint)[0] if get_origin(hint) is Annotated else hint
        for field in fields(kind)  # pyright: ignore[reportArgumentType]
        if (hint := hints[field.name]) is not None
    }


def _convert(value: Any, hint: Any, table: Table, key: str) -> Any:
    """`value` as `hint` wants it."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _convert_any(value, [a for a in arguments if a is not types.NoneType], table, key)
    if origin is tuple and isinstance(value, list):
        kinds = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        if len(kinds) == len(value):
            return tuple(_convert(v, kind, table, key) for v, kind in zip(value, kinds, strict=True))
    if hint is Path and isinstance(value, str):
        return table.folder / Path(value).expanduser()
    if hint is float and type(value) is int:
        return float(value)
    if (origin is Literal and value in arguments) or (hint in (int, float, str, bool) and type(value) is hint):
        return value
    wanted = " or ".join(map(repr, arguments)) if origin is Literal else getattr(hint, "__name__", str(hint))
    raise ValueError(f"{table.where} {key}: expected {str(hint) if origin is tuple else wanted}, found {value!r}")


def _convert_any(value: Any, hints: list[Any], table: Table, key: str) -> Any:
    """`value` as the first of `hints` that it fits."""
    for hint in hints[:-1]:
        try:
            return _convert(value, hint, table, key)
        except ValueError:
            continue
    return _convert(value, hints[-1], table, key)
