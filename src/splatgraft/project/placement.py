"""placement.json: transforms of objects into the target scene, and the Gaussians that are erased from it.

    {"objects": [{"object": "object.ply", "scale": 1.0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}],
     "erased": "erased.npy"}

`rotation` is a wxyz quaternion or a 3x3 matrix of rows. `object` and `erased` are optional paths, relative to the file.
x_in_target = scale * rotation @ x_in_object + translation. erased.npy has one bool per Gaussian of the target.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.formats.json_file import array, excerpt, load, number, save
from splatgraft.project.gaussian_flags import read_flags, write_flags
from splatgraft.project.layout import ERASED_FILE
from splatgraft.runtime.files import relative_name

_DEFAULTS = {"object": None, "scale": 1.0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}
_RIGID = 1e-4  # largest entry of R R^T - I; accepts files with six digits, refuses a scale or shear in the matrix


@dataclass(frozen=True)
class ObjectPlacement:
    """The placement of one object."""

    target_from_object: Similarity
    """Transform from the object's capture to the target's."""
    object_path: Path | None = None
    """File of the object's Gaussians; None if the placement names none."""


@dataclass(frozen=True)
class Placement:
    """The content of a placement.json."""

    objects: tuple[ObjectPlacement, ...]
    """Objects in the order in which they are baked into the composite; may be empty."""
    erased: Bool[Tensor, "n"] | None = None
    """Mask of the target's Gaussians that are left out; None if none is."""


def read_placement(path: Path) -> Placement:
    """Read placement.json and the erased.npy that it names."""
    content = load(path)
    if not isinstance(content, dict) or not isinstance(content.get("objects"), list):
        raise ValueError(f'{path}: expected an object with a list "objects", found {excerpt(content)}')
    unknown = sorted(set(content) - {"objects", "erased"})
    if unknown:
        raise ValueError(f'{path}: expected the keys "objects" and "erased", found also {unknown}')
    entries, folder = content["objects"], path.parent
    objects = tuple(object_from_json(entry, folder, f"{path}: objects[{i}]") for i, entry in enumerate(entries))
    erased = _file(content.get("erased"), folder, f"{path}: erased")
    return Placement(objects=objects, erased=None if erased is None else read_flags(erased))


def write_placement(path: Path, placement: Placement) -> None:
    """Write placement.json, and erased.npy beside it if anything is erased; reading restores both exactly."""
    content: dict[str, Any] = {"objects": [object_to_json(item, path.parent) for item in placement.objects]}
    if placement.erased is not None:
        content["erased"] = ERASED_FILE
        write_flags(path.parent / ERASED_FILE, placement.erased)
    save(path, content)


def object_to_json(item: ObjectPlacement, folder: Path) -> dict[str, Any]:
    """Convert one object to JSON's types, its path relative to `folder`; `object_from_json` restores it exactly."""
    named = {} if item.object_path is None else {"object": relative_name(item.object_path, folder)}
    move = item.target_from_object
    return named | {
        "scale": move.scale,
        "rotation": move.rotation.tolist(),
        "translation": move.translation.tolist(),
    }


def object_from_json(entry: Any, folder: Path, where: str) -> ObjectPlacement:
    """Convert an entry of `objects`, with its path relative to `folder`; `where` is for messages."""
    if not isinstance(entry, dict) or not set(entry) <= set(_DEFAULTS):
        raise ValueError(f"{where}: expected an object with only {', '.join(_DEFAULTS)}, found {excerpt(entry)}")
    given = _DEFAULTS | entry
    scale, translation = number(where, given, "scale"), array(where, given, "translation", ((3,),))
    if scale <= 0 or not np.isfinite(translation).all():
        raise ValueError(f"{where}: expected a scale above 0 and a finite translation, found {excerpt(entry)}")
    move = Similarity(scale, _rotation(given, where), torch.from_numpy(translation).float())
    return ObjectPlacement(move, _file(given["object"], folder, f"{where} object"))


def _file(name: Any, folder: Path, where: str) -> Path | None:
    if name is not None and not isinstance(name, str):
        raise ValueError(f"{where}: expected a file name, found {excerpt(name)}")
    return None if name is None else folder / name


def _rotation(entry: dict[str, Any], where: str) -> Float[Tensor, "3 3"]:
    given = torch.from_numpy(array(where, entry, "rotation", ((4,), (3, 3))))
    if given.ndim == 1:
        if not 1e-6 < float(given.norm()) < float("inf"):
            raise ValueError(f"{where}: expected a finite quaternion other than zero, found {given.tolist()}")
        return rotation_from_quaternion(given[None])[0].float()
    error = (given @ given.T - torch.eye(3, dtype=given.dtype)).abs().max()
    if not error <= _RIGID or torch.linalg.det(given) < 0:
        raise ValueError(f"{where}: expected a rotation that is orthonormal with determinant 1, found {given.tolist()}")
    return given.float()
