"""All tables and keys of project.toml, read from the dataclasses of the steps, and a project.toml with all of them."""

import ast
import inspect
import json
import textwrap
import types
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from splatgraft.project.step_table import STEPS
from splatgraft.runtime.settings import choices, default_of, field_types

_TYPE_NAMES = {int: "integer", float: "number", bool: "true or false", str: "text", Path: "path"}
_EXAMPLES = {int: "1", float: "1.0", bool: "true", str: '"text"', Path: '"path"'}


@dataclass(frozen=True)
class Key:
    """One key of a table of project.toml."""

    name: str
    type: str
    """Type in words, such as `number`, `list of 3 numbers` or `"fast" or "adam"`."""
    default: str
    """The default as TOML, or `none` or `required` if there is no such value."""
    meaning: str
    """One or more sentences, without line breaks."""
    example: str
    """A value of the right type as TOML: the default if TOML can express it."""


@dataclass(frozen=True)
class KeyTable:
    """One table of project.toml."""

    name: str
    """Name of the table in the file, without brackets, e.g. `source.reconstruct`."""
    meaning: str
    """Purpose of the step or of the table."""
    keys: tuple[Key, ...]
    """Keys in the order of the command's help."""
    variants: tuple["KeyTable", ...] = ()
    """Tables with the further keys of each choice of a key such as `method` in [harmonize]."""


def describe_table(
    name: str, kind: type, *, given: Mapping[str, Path] | None = None, omitted: frozenset[str] = frozenset({"out"})
) -> KeyTable:
    """Describe the table whose keys are the fields of a step, without those `omitted`; nested fields are keys, too.

    `given`: default paths that a project gives, by field, relative to the project's folder.
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
    """Read the docstring after each field of a dataclass, by field, without line breaks; fields may have none."""
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
    """List the keys of a dataclass; an instance `default` replaces the class's defaults."""
    found: list[Key] = []
    for field in fields(kind):
        hint = field_types(kind)[field.name]
        value = default_of(field) if default is None else getattr(default, field.name)
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
    """Describe a type in words, e.g. `list of 3 numbers`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(type_words(each) for each in arguments if each is not types.NoneType)
    if origin is Literal:
        return " or ".join(json.dumps(value) for value in arguments)
    if origin is tuple:
        count = "" if arguments[-1] is ... else f"{len(arguments)} "
        one = type_words(arguments[0])
        # the plural of "list of 3 numbers" is inside
        return f"list of {count}" + (one.replace("list", "lists", 1) if one.startswith("list") else f"{one}s")
    return _TYPE_NAMES[hint]


def type_example(hint: Any) -> str:
    """Return a value of the type as TOML."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return type_example(next(each for each in arguments if each is not types.NoneType))
    if origin is Literal:
        return json.dumps(arguments[0])
    if origin is tuple:
        kinds = arguments[:1] if arguments[-1] is ... else arguments
        return f"[{', '.join(type_example(each) for each in kinds)}]"
    return _EXAMPLES[hint]


def _toml(value: Any) -> str:
    # JSON's strings, numbers, booleans and lists are TOML's too
    return json.dumps(list(value) if isinstance(value, tuple) else str(value) if isinstance(value, Path) else value)


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


_CAPTURE_KEYS = {
    "source": "The capture with the object; also takes every key of [capture], for this capture alone.",
    "target": "The capture that receives the object; also takes every key of [capture], for this capture alone.",
}
_SIDE_KEYS = (
    Key("capture", "path", "required without scene", "Photos, a video, a COLMAP folder or one with transforms.json.",
        example='"photos"'),
    Key("scene", "path", "none", "A trained scene (.ply, .spz, .splat, .sog, .glb, .ksplat), which replaces "
        "the reconstruction; if there is no capture, pictures are made of it.", example='"trained.ply"'),
)  # fmt: skip


def project_keys() -> tuple[KeyTable, ...]:
    """List every table of project.toml with all its keys: name, type, default and meaning, in the order of the flow.

    Paths of results are relative to the folder of project.toml. [source.reconstruct] and [target.reconstruct] take the
    keys of [reconstruct] for one capture alone; the source is a draft unless its own table gives a quality.
    """
    sides = tuple(KeyTable(side, meaning, _SIDE_KEYS) for side, meaning in _CAPTURE_KEYS.items())
    # [capture] and [reconstruct] serve both sides: one path for both would be wrong
    steps = tuple(
        describe_table(
            row.command,
            row.load(),
            given=row.inputs,
            omitted=frozenset({"out", "capture"} if row.per_capture else {"out"}),
        )
        for row in STEPS
        if row.has_table
    )
    return sides + steps


_HEAD = """\
# A splatgraft project with every key. A line such as `#key = value` is a key that is not set; the value is its default,
# or an example if the default is none. Paths are relative to this file.
"""
_OF_ONE_CAPTURE = (
    "[source.reconstruct] and [target.reconstruct] take these keys for one capture alone. The source is a draft unless "
    "its own table gives a quality, because the object is fitted again."
)
_WIDTH = 118


def full_project_text(*, source: str, target: str) -> str:
    """Write a commented project.toml with every key of every table.

    `source` and `target` are the lines that name the captures or scenes, e.g. `capture = "photos"`.
    """
    named = {"source": source, "target": target}
    lines = [_HEAD]
    for table in project_keys():
        lines += [f"[{table.name}]", *_prose(table.meaning)]
        if table.name in named:
            lines.append(named[table.name])
        if table.name == "reconstruct":
            lines += _prose(_OF_ONE_CAPTURE)
        for key in table.keys:
            if f"{key.name} = " not in named.get(table.name, ""):
                lines += _key_lines(key)
        for variant in table.variants:
            lines += [f"# with {_choice_key(table)} = {json.dumps(variant.name)}:", *_prose(variant.meaning)]
            for key in variant.keys:
                lines += _key_lines(key)
        lines.append("")
    return "\n".join(lines)


def _choice_key(table: KeyTable) -> str:
    """Return the key whose value chooses among the variants."""
    first = json.dumps(table.variants[0].name)
    return next(key.name for key in table.keys if key.type.split(" or ")[0] == first)


def _key_lines(key: Key) -> Iterator[str]:
    yield from _prose(f"{key.name}: {key.type}, {_default_words(key)}. {key.meaning}")
    yield f"#{key.name} = {key.example}"


def _default_words(key: Key) -> str:
    return key.default if key.default.startswith("required") else f"default {key.default}"


def _prose(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False)
