"""corrections.npy: the user's corrections to the selection of an object's Gaussians.

One int8 per Gaussian of the source scene: 1 added, -1 removed, 0 as selected by the masks.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int8
from torch import Tensor

from splatgraft.runtime.atomic_file import atomic_write


def read_corrections(path: Path) -> Int8[Tensor, "n"]:
    """The corrections in `path`.

    Raises:
        ValueError: Where the file is no one-dimensional int8 array of -1, 0 and 1.
    """
    try:
        array = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: expected a .npy of corrections, found no file") from error
    except (ValueError, OSError, EOFError, SyntaxError, MemoryError) as error:
        raise ValueError(f"{path}: expected a .npy of corrections, found {type(error).__name__}: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype != np.int8 or array.ndim != 1 or (abs(array) > 1).any():
        found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{path}: expected one int8 of -1, 0 or 1 per Gaussian, found {found}")
    return torch.from_numpy(array)


def write_corrections(path: Path, corrections: Int8[Tensor, "n"]) -> None:
    """Write the array, atomically."""
    with atomic_write(path) as stream:
        np.save(stream, corrections.cpu().numpy())
