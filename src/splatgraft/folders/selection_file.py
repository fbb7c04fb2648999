"""Files with one bool per Gaussian of a scene."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from splatgraft.formats.placement import read_erased
from splatgraft.runtime.atomic_file import atomic_write


def read_selection(path: Path, count: int, scene: Path) -> Bool[Tensor, "n"]:
    """The flags in `path`, one for each of the `count` Gaussians of `scene`.

    Raises: ValueError where the file is no array of bools, or has another number of them.
    """
    flags = read_erased(path)
    if len(flags) != count:
        raise ValueError(f"{path}: expected one flag for each of the {count} Gaussians of {scene}, found {len(flags)}")
    return flags


def write_selection(path: Path, flags: Bool[Tensor, "n"]) -> None:
    """Write the flags as a .npy."""
    with atomic_write(path) as stream:
        np.save(stream, flags.cpu().numpy())
