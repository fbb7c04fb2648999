"""JSON files, written atomically, and checked access to their numbers, image sides, file names and arrays.

A value of another kind raises a ValueError that begins with `where`, the file or a place in it.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from splatgraft.formats.captures.views import MAX_SIDE
from splatgraft.runtime.files import atomic_write

_LONGEST = 60  # characters of a value in an error message


def load(path: Path) -> Any:
    """Read a JSON file."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a JSON file, found none")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, found {str(error)[:200]}") from None


def save(path: Path, content: Any) -> None:
    """Write JSON with indents, atomically."""
    with atomic_write(path) as stream:
        stream.write((json.dumps(content, indent=1) + "\n").encode())


def number(where: Path | str, entry: dict[str, Any], key: str, default: float | None = None) -> float:
    """Return a finite number below 1e9."""
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise ValueError(f"{where}: expected a finite number for '{key}', found {excerpt(value)}")
    return float(value)


def whole_side(where: Path | str, entry: dict[str, Any], key: str) -> int:
    """Return an image side, pixels."""
    value = number(where, entry, key)
    if not (value.is_integer() and 1 <= value <= MAX_SIDE):
        raise ValueError(f"{where}: expected a whole number from 1 to {MAX_SIDE} for '{key}', found {value:g}")
    return int(value)


def text(where: Path | str, entry: dict[str, Any], key: str) -> str:
    """Return a file name, with forward slashes."""
    value = entry.get(key)
    if not isinstance(value, str) or not value.strip("./\\ ") or not value.isprintable() or len(value) > 1024:
        raise ValueError(f"{where}: expected a file name for '{key}', found {excerpt(value)}")
    return value.replace("\\", "/")


def array(where: Path | str, entry: dict[str, Any], key: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """Return numbers in one of `shapes`, float64; they may be nan."""
    value = entry.get(key)
    try:
        out = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        out = np.empty(0)
    if out.shape not in shapes:
        raise ValueError(f"{where}: expected numbers of shape {shapes[0]} for '{key}', found {excerpt(value)}")
    return out


def excerpt(value: Any) -> str:
    """Write the start of a value as text on one line."""
    return repr(value)[:_LONGEST] if not isinstance(value, int) or abs(value) < 1e30 else "a huge number"
