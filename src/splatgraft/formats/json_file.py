"""Checked access to the values of a JSON file: numbers, image sides, file names and arrays."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from splatgraft.formats.captures.views import MAX_SIDE

_LONGEST = 60
"""Characters of a value in an error message."""


def load(path: Path) -> Any:
    """The file's content.

    Raises: ValueError where the file is missing or is no JSON.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a JSON file, found none")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, found {str(error)[:200]}") from None


def number(where: Path | str, entry: dict[str, Any], key: str, default: float | None = None) -> float:
    """A finite number below 1e9.

    Raises: ValueError where the value is none.
    """
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise ValueError(f"{where}: expected a finite number for '{key}', found {excerpt(value)}")
    return float(value)


def whole_side(where: Path | str, entry: dict[str, Any], key: str) -> int:
    """An image side, pixels.

    Raises: ValueError where the value is no whole number from 1 to `MAX_SIDE`.
    """
    value = number(where, entry, key)
    if not (value.is_integer() and 1 <= value <= MAX_SIDE):
        raise ValueError(f"{where}: expected a whole number from 1 to {MAX_SIDE} for '{key}', found {value:g}")
    return int(value)


def text(where: Path | str, entry: dict[str, Any], key: str) -> str:
    """A file name, with forward slashes.

    Raises: ValueError where the value is none.
    """
    value = entry.get(key)
    if not isinstance(value, str) or not value.strip("./\\ ") or not value.isprintable() or len(value) > 1024:
        raise ValueError(f"{where}: expected a file name for '{key}', found {excerpt(value)}")
    return value.replace("\\", "/")


def array(where: Path | str, entry: dict[str, Any], key: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """Numbers in one of `shapes`, float64; they may be nan.

    Raises: ValueError where the value has another shape.
    """
    value = entry.get(key)
    try:
        out = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        out = np.empty(0)
    if out.shape not in shapes:
        raise ValueError(f"{where}: expected numbers of shape {shapes[0]} for '{key}', found {excerpt(value)}")
    return out


def excerpt(value: Any) -> str:
    """The start of a value as text on one line."""
    return repr(value)[:_LONGEST] if not isinstance(value, int) or abs(value) < 1e30 else "a huge number"
