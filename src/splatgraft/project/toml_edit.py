"""Set keys of a TOML text line by line, so that comments and all other lines stay unchanged.

tomlkit 0.15 would add a new key after the comments that belong to the next table.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from typing import Any


def with_keys(text: str, table: str, values: Mapping[str, Any]) -> str:
    """Set keys of one top-level table; None removes a key. Raises ValueError if the layout is not one key per line."""
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
    if _comparable(found) != _comparable(wanted):
        raise ValueError(f"[{table}]: expected one plain `key = value` per line, found another layout; edit it by hand")
    return text


def _with_key(text: str, table: str, key: str, value: Any) -> str:
    # splitlines would also split at characters that do not end a line in TOML
    lines = text.removesuffix("\n").split("\n")
    start = next((i for i, line in enumerate(lines) if re.match(rf"\s*\[{re.escape(table)}\]\s*(#.*)?$", line)), None)
    if start is None:
        if value is None:
            return text
        return "\n".join([*lines, "", f"[{table}]", f"{key} = {_toml_value(value)}", ""])
    end = next((i for i in range(start + 1, len(lines)) if re.match(r"\s*\[", lines[i])), len(lines))
    at = next((i for i in range(start + 1, end) if re.match(rf"\s*{re.escape(key)}\s*=", lines[i])), None)
    new = [] if value is None else [f"{key} = {_toml_value(value)}"]
    if at is None:
        # after the table's last key, so that comments before the next table stay with that table
        last = max((i for i in range(start, end) if i == start or re.match(r"\s*[\w\"'\]]", lines[i])), default=start)
        lines[last + 1 : last + 1] = new
    else:
        lines[at : at + _value_lines(lines, at)] = new
    return "\n".join(lines) + "\n"


def _value_lines(lines: list[str], at: int) -> int:
    """Count the lines of the value that begins in line `at`."""
    for count in range(1, len(lines) - at + 1):
        try:
            tomllib.loads("\n".join(lines[at : at + count]))
        except tomllib.TOMLDecodeError:
            continue
        return count
    return 1


def _toml_value(value: Any) -> str:
    # JSON strings, numbers, booleans and lists are valid TOML
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


def _comparable(content: Any) -> Any:
    return json.loads(json.dumps(content, default=str))
