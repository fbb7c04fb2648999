"""Description of the keys of project.toml, read from the dataclasses of the steps: name, type, default and meaning."""

import ast
import inspect
import json
import textwrap
import types
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from splatgraft.runtime.settings import choices, field_types

_TYPE_NAMES = {int: "integer", float: "number", bool: "true or false", str: "text", Path: "path"}
_EXAMPLES = {int: "1", float: "1.0", bool: "true", str: '"text"', Path: '"path"'}


@dataclass(frozen=True)
class Key:
    """One key of a table of project.toml."""

    name: str
    type: str
    """In words, such as `number`, `list of 3 numbers` or `"fast" or "adam"`."""
    default: str
    """The default as TOML, or in words where TOML has no such value: `none` or `required`."""
    meaning: str
    """One or more sentences, without line breaks."""
    example: str
    """A value of the right type as TOML: the default where it can be written."""


@dataclass(frozen=True)
class KeyTable:
    """One table of project.toml."""

    name: str
    """As in the file, without brackets, e.g. `source.reconstruct`."""
    meaning: str
    """What the step does, or what the table is for."""
    keys: tuple[Key, ...]
    """In the order in which the command's help lists them."""
    variants: tuple["KeyTable", ...] = ()
    """Of a table with a choice, such as `method` in [harmonize]: the further keys that each choice takes, by name."""


def describe_table(
    name: str, kind: type, *, given: Mapping[str, Path] | None = None, omitted: frozenset[str] = frozenset({"out"})
) -> KeyTable:
    """Describe the table whose keys are the fields of a step.

    Args:
        name: Name of the table.
        kind: Dataclass of the step; the fields of nested dataclasses are keys of the same table.
        given: Default paths that a project supplies, by field, relative to the project's folder.
        omitted: Fields that are no keys.
    """
    keys = tuple(key for key in _keys(kind, None, given or {}) if key.name not in omitted)
    variants = tuple(
        KeyTable(choice, _one_line(inspect.getdoc(inner)), tuple(_keys(inner, None, {})))
        for hint in field_types(kind).values()
        for choice, inner in choices(hint).items()
    )
    return KeyTable(name, _one_line(inspect.getdoc(kind)), keys, variants)


@cache
def field_docstrings(kind: type) -> Mapping[str, str]:
    """The docstring that follows each field of a dataclass, by field, without line breaks; fields may have none."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if is_dataclass(base):
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
            assert isinstance(body, ast.ClassDef)
            for statement, following in zip(body.body, body.body[1:], strict=False):
                if not (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)):
                    continue
                if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
                    found[statement.target.id] = _one_line(str(following.value.value))
    return found


def _keys(kind: type, default: Any, given: Mapping[str, Path]) -> list[Key]:
    """The keys of a dataclass; defaults are those of the instance `default` where there is one."""
    found: list[Key] = []
    for field in fields(kind):
        hint = field_types(kind)[field.name]
        value = _default(field) if default is None else getattr(default, field.name)
        if named := choices(hint):
            words, meaning = " or ".join(map(json.dumps, named)), field_docstrings(kind).get(field.name, "")
            found.append(Key(field.name, words, json.dumps(value.name), meaning, json.dumps(value.name)))
        elif is_dataclass(hint):
            found += _keys(hint, None if value is MISSING else value, given)  # pyright: ignore[reportArgumentType]
        else:
            value = given.get(field.name, value)
            found.append(_key(field.name, hint, value, field_docstrings(kind).get(field.name, "")))
    return found


def _key(name: str, hint: Any, value: Any, meaning: str) -> Key:
    words = "required" if value is MISSING else "none" if value is None else _toml(value)
    example = type_example(hint) if value is MISSING or value is None else _toml(value)
    return Key(name, type_words(hint), words, meaning, example)


def type_words(hint: Any) -> str:
    """A type in the words of the reference, e.g. `list of 3 numbers`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(type_words(each) for each in arguments if each is not types.NoneType)
    if origin is Literal:
        return " or ".join(json.dumps(value) for value in arguments)
    if origin is tuple:
        count = "" if arguments[-1] is ... else f"{len(arguments)} "
        return f"list of {count}{_TYPE_NAMES[arguments[0]]}s"
    return _TYPE_NAMES[hint]


def type_example(hint: Any) -> str:
    """A value of the type, as TOML."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return type_example(next(each for each in arguments if each is not types.NoneType))
    if origin is Literal:
        return json.dumps(arguments[0])
    if origin is tuple:
        kinds = arguments[:1] if arguments[-1] is ... else arguments
        return f"[{', '.join(type_example(each) for each in kinds)}]"
    return _EXAMPLES[hint]


def _default(field: "Field[Any]") -> Any:
    return field.default_factory() if field.default_factory is not MISSING else field.default


def _toml(value: Any) -> str:
    # JSON's strings, numbers, booleans and lists are TOML's too
    return json.dumps(list(value) if isinstance(value, tuple) else str(value) if isinstance(value, Path) else value)


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())
