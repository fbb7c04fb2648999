"""placement.json: transforms of objects into the target scene, and the Gaussians that are erased from it.

    {"objects": [{"object": "object.ply", "scale": 1.0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}],
     "erased": "erased.npy"}

`rotation` is a wxyz quaternion or a 3x3 matrix of rows; `object` and `erased` may be missing and are relative to the
file; x_in_target = scale * rotation @ x_in_object + translation. erased.npy: one bool per Gaussian of the target.
"""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.runtime.atomic_file import atomic_write

_OBJECT_KEYS = frozenset({"object", "scale", "rotation", "translation"})


@dataclass(frozen=True)
class ObjectPlacement:
    """The placement of one object."""

    target_from_object: Similarity
    """From the object's capture to the target's."""
    object_path: Path | None = None
    """File of the object's Gaussians; None where the placement names none."""


@dataclass(frozen=True)
class Placement:
    """The content of a placement.json."""

    objects: tuple[ObjectPlacement, ...]
    """In the order in which they are baked into the composite; may be empty."""
    erased: Bool[Tensor, "n"] | None = None
    """True where a Gaussian of the target is left out; None where none is."""


def read_placement(path: Path) -> Placement:
    """Read placement.json and the erased.npy that it names.

    Raises: ValueError where either file is missing, broken or inconsistent.
    """
    content = _load_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("objects"), list):
        raise ValueError(f'{path}: expected an object with a list "objects", found {_short(content)}')
    unknown = sorted(set(content) - {"objects", "erased"})
    if unknown:
        raise ValueError(f'{path}: expected the keys "objects" and "erased", found also {unknown}')
    objects = tuple(_parse_object(entry, path, f"objects[{i}]") for i, entry in enumerate(content["objects"]))
    erased = content.get("erased")
    if erased is not None and not isinstance(erased, str):
        raise ValueError(f'{path}: expected a file name as "erased", found {_short(erased)}')
    return Placement(objects=objects, erased=None if erased is None else read_erased(path.parent / erased))


def write_placement(path: Path, placement: Placement) -> None:
    """Write placement.json, and erased.npy beside it where anything is erased; both are read back exactly."""
    entries = []
    for item in placement.objects:
        entry: dict[str, Any] = {}
        if item.object_path is not None:
            entry["object"] = os.path.relpath(item.object_path, path.parent)
        move = item.target_from_object
        entry |= {
            "scale": move.scale,
            "rotation": move.rotation.tolist(),
            "translation": move.translation.tolist(),
        }
        entries.append(entry)
    content: dict[str, Any] = {"objects": entries}
    if placement.erased is not None:
        content["erased"] = "erased.npy"
        with atomic_write(path.parent / "erased.npy") as stream:
            np.save(stream, placement.erased.cpu().numpy())
    with atomic_write(path) as stream:
        stream.write((json.dumps(content, indent=1) + "\n").encode())


def read_erased(path: Path) -> Bool[Tensor, "n"]:
    """Which Gaussians of a scene are left out.

    Raises: ValueError where the file is no one-dimensional bool array.
    """
    try:
        array = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: expected a .npy of bools, found no file") from error
    except (ValueError, OSError, EOFError, SyntaxError, MemoryError) as error:
        raise ValueError(f"{path}: expected a .npy of bools, found {type(error).__name__}: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype != np.bool_ or array.ndim != 1:
        found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{path}: expected a one-dimensional array of bools, found {found}")
    return torch.from_numpy(array)


def _load_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: expected a placement, found no file") from error
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, found {type(error).__name__}: {error}") from error


def _parse_object(entry: Any, path: Path, where: str) -> ObjectPlacement:
    if not isinstance(entry, dict) or not set(entry) <= _OBJECT_KEYS:
        raise ValueError(f"{path}: expected {where} to have only {sorted(_OBJECT_KEYS)}, found {_short(entry)}")
    name = entry.get("object")
    if name is not None and not isinstance(name, str):
        raise ValueError(f'{path}: expected a file name as {where} "object", found {_short(name)}')
    scale = _numbers(entry.get("scale", 1.0), (), path, f"{where} scale")
    if float(scale) <= 0:
        raise ValueError(f"{path}: expected {where} scale above 0, found {float(scale)}")
    move = Similarity(
        scale=float(scale),
        rotation=_parse_rotation(entry.get("rotation", [1, 0, 0, 0]), path, f"{where} rotation"),
        translation=_numbers(entry.get("translation", [0, 0, 0]), (3,), path, f"{where} translation").float(),
    )
    return ObjectPlacement(target_from_object=move, object_path=None if name is None else path.parent / name)


def _parse_rotation(value: Any, path: Path, where: str) -> Tensor:
    if isinstance(value, list) and value and isinstance(value[0], list):
        matrix = _numbers(value, (3, 3), path, where)
        # accepts files with six digits, refuses a scale or shear in the matrix
        if (matrix @ matrix.T - torch.eye(3, dtype=matrix.dtype)).abs().max() > 1e-4 or torch.linalg.det(matrix) < 0:
            raise ValueError(f"{path}: expected {where} to be orthonormal with determinant 1, found {_short(value)}")
        return matrix.float()
    quaternion = _numbers(value, (4,), path, where)
    if not float(quaternion.norm()) > 1e-6:
        raise ValueError(f"{path}: expected {where} to be a quaternion other than zero, found {_short(value)}")
    return rotation_from_quaternion(quaternion[None])[0].float()


def _numbers(value: Any, shape: tuple[int, ...], path: Path, where: str) -> Tensor:
    found = np.array(value, dtype=object)
    kinds = all(isinstance(x, int | float) and not isinstance(x, bool) for x in found.flatten())
    if found.shape != shape or not kinds or not all(math.isfinite(x) for x in found.flatten()):
        wanted = "x".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise ValueError(f"{path}: expected {where} to be {wanted}, found {_short(value)}")
    return torch.tensor(found.astype(np.float64))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
