"""Every table and key of project.toml, and the commented project.toml that lists them all."""

import json
import textwrap
from collections.abc import Iterator
from pathlib import Path

from splatgraft.project.layout import Layout
from splatgraft.project.reference import Key, KeyTable, describe_table
from splatgraft.workflow.flow import STEPS, default_paths

_CAPTURE_KEYS = {
    "source": "The capture with the object; also takes every key of [capture], for this capture alone.",
    "target": "The capture that receives the object; also takes every key of [capture], for this capture alone.",
}
_SIDE_KEYS = (
    Key("capture", "path", "required without scene", "Photos, a video, a COLMAP folder or one with transforms.json.",
        example='"photos"'),
    Key("scene", "path", "none", "A trained scene (.ply, .spz, .splat, .sog, .glb, .ksplat), which is taken "
        "over instead of being reconstructed; without a capture, pictures are made of it.", example='"trained.ply"'),
)  # fmt: skip


def project_keys() -> tuple[KeyTable, ...]:
    """Every table of project.toml with all its keys: name, type, default and meaning, in the order of the flow.

    Paths of results are relative to the folder of project.toml. [source.reconstruct] and [target.reconstruct] take the
    keys of [reconstruct] for one capture alone.
    """
    given = default_paths(Layout(Path()))
    sides = tuple(KeyTable(side, meaning, _SIDE_KEYS) for side, meaning in _CAPTURE_KEYS.items())
    # [capture] and [reconstruct] serve both sides: one path for both would be wrong
    steps = tuple(
        describe_table(
            kind.__name__.lower(),
            kind,
            given=given.get(kind),
            omitted=frozenset({"out"} if kind in given else {"out", "capture"}),
        )
        for kind in STEPS
    )
    return sides + steps


_HEAD = """\
# A splatgraft project with every key. A line such as `#key = value` is a key that is not set; the value is its default,
# or an example where the default is none. Paths are relative to this file.
"""
_WIDTH = 118


def full_project_text(*, source: str, target: str) -> str:
    """Write a commented project.toml with every key of every table.

    Args:
        source: The line that names the capture or scene with the object, e.g. `capture = "photos"`.
        target: The same for the capture or scene that receives it.
    """
    named = {"source": source, "target": target}
    lines = [_HEAD]
    for table in project_keys():
        lines += [f"[{table.name}]", *_prose(table.meaning)]
        if table.name in named:
            lines.append(named[table.name])
        if table.name == "reconstruct":
            lines += _prose("[source.reconstruct] and [target.reconstruct] take these keys for one capture alone.")
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
    """The key whose value chooses among the variants."""
    first = json.dumps(table.variants[0].name)
    return next(key.name for key in table.keys if key.type.split(" or ")[0] == first)


def _key_lines(key: Key) -> Iterator[str]:
    yield from _prose(f"{key.name}: {key.type}, {_default_words(key)}. {key.meaning}")
    yield f"#{key.name} = {key.example}"


def _default_words(key: Key) -> str:
    return key.default if key.default.startswith("required") else f"default {key.default}"


def _prose(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False)
