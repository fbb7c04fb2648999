"""Changes keys of a TOML text and leaves all other lines, comments too, as they are. Knows no particular key."""

import json
import re
import tomllib
from collections.abc import Mapping
from typing import Any


def with_keys(text: str, table: str, values: Mapping[str, Any]) -> str:
    """`text` with the keys of one top-level `table` set; None removes a key.

    Raises: ValueError where the text is laid out so that this cannot be done line by line.
    """
    wanted = tomllib.loads(text)
    inside = dict(wanted.get(table, {}))
    for key, value in values.items():
        inside.pop(key, None)
        if value is not None:
            inside[key] = value
    if inside or table in wanted:
        wanted[table] = inside
    for key, value in values.items():
        text = _with_key(text, table, key, value)
    try:
        found = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        found = None
    if _plain(found) != _plain(wanted):
        raise ValueError(f"[{table}]: expected one plain `key = value` per line, found another layout; edit it by hand")
    return text


def _with_key(text: str, table: str, key: str, value: Any) -> str:
    # not splitlines, for which a string may hold ends of lines that TOML does not know
    lines = text.removesuffix("\n").split("\n")
    start = next((i for i, line in enumerate(lines) if re.match(rf"\s*\[{re.escape(table)}\]\s*(#.*)?$", line)), None)
    if start is None:
        if value is None:
            return text
        return "\n".join([*lines, "", f"[{table}]", f"{key} = {_written(value)}", ""])
    end = next((i for i in range(start + 1, len(lines)) if re.match(r"\s*\[", lines[i])), len(lines))
    at = next((i for i in range(start + 1, end) if re.match(rf"\s*{re.escape(key)}\s*=", lines[i])), None)
    new = [] if value is None else [f"{key} = {_written(value)}"]
    if at is None:
        # behind the table's last key, so that comments that introduce the next table stay with it
        last = max((i for i in range(start, end) if i == start or re.match(r"\s*[\w\"'\]]", lines[i])), default=start)
        lines[last + 1 : last + 1] = new
    else:
        lines[at : at + _value_lines(lines, at)] = new
    return "\n".join(lines) + "\n"


def _value_lines(lines: list[str], at: int) -> int:
    """How many lines the value that begins in line `at` takes."""
    for count in range(1, len(lines) - at + 1):
        try:
            tomllib.loads("\n".join(lines[at : at + count]))
        except tomllib.TOMLDecodeError:
            continue
        return count
    return 1


def _written(value: Any) -> str:
    # JSON's strings, numbers, booleans and lists are TOML's too
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


def _plain(content: Any) -> Any:
    return json.loads(json.dumps(content, default=str))
