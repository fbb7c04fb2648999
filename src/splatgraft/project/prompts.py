"""Files of prompts, as TOML or JSON: points and rectangles by which a user marks the object in single pictures.

    ["DSC_0423.jpg"]
    inside = [[412, 300], [380, 351]]   # on the object: x to the right, y down, pixels as a viewer shows the file
    outside = [[100, 500]]              # points beside it
    box = [300, 200, 520, 480]          # left, top, right, bottom of a rectangle that holds the whole object

Keys are names of pictures, with or without folder and suffix. In JSON: {"DSC_0423": {"inside": [[412, 300]]}}.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt
from splatgraft.formats.json_file import excerpt, load, save
from splatgraft.runtime.settings import read_toml

_KEYS = ("inside", "outside", "box")


def read_prompts(path: Path) -> dict[str, ViewPrompt]:
    """Read the prompts of a file, by the name of the picture."""
    return prompts_from_json(load(path) if path.suffix.lower() == ".json" else read_toml(path), str(path))


def prompts_from_json(content: Any, where: str) -> dict[str, ViewPrompt]:
    """Convert a file's content to prompts, by the name of the picture; `where` is for messages."""
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{where}: expected a table of points per picture, found {excerpt(content)}")
    return {name: _prompt(where, name, entry) for name, entry in content.items()}


def write_prompts(path: Path, prompts: Mapping[str, ViewPrompt]) -> None:
    """Write prompts as JSON; `read_prompts` restores them exactly."""
    assert path.suffix.lower() == ".json", path
    save(path, prompts_to_json(prompts))


def prompts_to_json(prompts: Mapping[str, ViewPrompt]) -> dict[str, Any]:
    """Convert prompts to JSON's types; `prompts_from_json` restores them exactly."""
    content = {}
    for name, prompt in prompts.items():
        points = {"inside": _decimal(prompt.inside), "outside": _decimal(prompt.outside)}
        box = {} if prompt.box is None else {"box": list(prompt.box)}
        content[name] = {key: value for key, value in points.items() if value} | box
    return content


def _decimal(points: Float[Tensor, "k 2"]) -> list[list[float]]:
    """Convert to the shortest decimal numbers that are read back as the same float32."""
    return [[float(str(number)) for number in point] for point in points.numpy().astype(np.float32)]


def _prompt(file: str, name: str, entry: Any) -> ViewPrompt:
    where = f"{file}: {name}"
    if not isinstance(entry, dict) or not entry or not set(entry) <= set(_KEYS):
        raise ValueError(f"{where}: expected a table with {', '.join(_KEYS)}, found {excerpt(entry)}")
    box = entry.get("box")
    if box is not None and not (_numbers(box, 4) and box[0] < box[2] and box[1] < box[3]):
        raise ValueError(f"{where}: expected box = [left, top, right, bottom], found {excerpt(box)}")
    corners = None if box is None else (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
    return ViewPrompt(_points(where, entry, "inside"), _points(where, entry, "outside"), corners)


def _points(where: str, entry: dict[str, Any], key: str) -> Float[Tensor, "k 2"]:
    value = entry.get(key, [])
    if not isinstance(value, list) or not all(_numbers(point, 2) for point in value):
        raise ValueError(f"{where}: expected {key} = [[x, y], ...], found {excerpt(value)}")
    return torch.tensor(value, dtype=torch.float32).reshape(-1, 2)


def _numbers(value: Any, count: int) -> bool:
    kinds = isinstance(value, list) and all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)
    return kinds and len(value) == count and all(abs(x) < 1e9 for x in value)
