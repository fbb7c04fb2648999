"""Files with one value per Gaussian of a scene: selected, erased, or corrected by a user.

Selections (`selection.npy`, `is_object.npy`, `erased.npy`) have one bool per Gaussian. `corrections.npy` has one int8
per Gaussian of the source scene: 1 added, -1 removed, 0 as selected by the masks.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int8
from torch import Tensor

from splatgraft.runtime.files import atomic_write


def read_flags(path: Path) -> Bool[Tensor, "n"]:
    """Read the flags in `path`."""
    return torch.from_numpy(_read(path, np.dtype(np.bool_)))


def read_selection(path: Path, count: int, scene: Path) -> Bool[Tensor, "n"]:
    """Read the flags in `path`, one for each of the `count` Gaussians of `scene`."""
    flags = read_flags(path)
    if len(flags) != count:
        raise ValueError(f"{path}: expected one flag for each of the {count} Gaussians of {scene}, found {len(flags)}")
    return flags


def read_corrections(path: Path) -> Int8[Tensor, "n"]:
    """Read the corrections in `path`."""
    corrections = _read(path, np.dtype(np.int8))
    if (abs(corrections) > 1).any():
        raise ValueError(f"{path}: expected one int8 of -1, 0 or 1 per Gaussian, found {int(corrections.max())}")
    return torch.from_numpy(corrections)


def write_flags(path: Path, flags: Bool[Tensor, "n"] | Int8[Tensor, "n"]) -> None:
    """Write a selection or corrections, atomically."""
    with atomic_write(path) as stream:
        np.save(stream, flags.cpu().numpy())


def _read(path: Path, kind: np.dtype) -> np.ndarray:
    try:
        array = np.load(path, allow_pickle=False)
        if isinstance(array, np.ndarray) and array.dtype == kind and array.ndim == 1:
            return array
        found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
    except FileNotFoundError:
        found = "no file"
    except (ValueError, OSError, EOFError, SyntaxError, MemoryError) as error:
        found = f"{type(error).__name__}: {error}"
    raise ValueError(f"{path}: expected a .npy with one {kind} per Gaussian, found {found}")
