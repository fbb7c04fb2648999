"""Examples for learning the light at a place: what is known of it, and what is true."""

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.place_description import (
    COLUMNS,
    ROWS,
    PlaceDescription,
    cell_solid_angles,
    describe_place,
    upright_from_world,
)
from splatgraft.relighting.light.true_light import panorama_pixels
from splatgraft.runtime.atomic_file import atomic_write

VERSION = 2
"""Of the description; examples of another version are refused."""


@dataclass(frozen=True)
class LightExample:
    """One place."""

    name: str
    """Of the scene and the place in it; examples of one scene share what stands before the slash."""
    place: PlaceDescription
    truth: Float[Tensor, "12 24 3"]
    """Mean linear radiance in each cell, suns included, at the exposure of the pictures; cells as of `place`."""

    @property
    def scene(self) -> str:
        """By which examples are held out together."""
        return self.name.partition("/")[0]


def light_example(
    name: str, found: EstimatedLight, panorama: Float[Tensor, "h w 3"], suns: Sequence[dict[str, Any]]
) -> LightExample:
    """An example of an estimate and the true light at the same place.

    Args:
        name: SCENE/PLACE.
        found: The estimate.
        panorama: True light without the suns, equirectangular, in the estimate's world frame.
        suns: Entries of suns.json: direction (unit, towards the sun) and irradiance (linear rgb).
    """
    rotation = upright_from_world(found.evidence.up)
    directions, solid_angles = panorama_pixels(panorama)
    power = panorama * solid_angles[..., None]
    towards = directions.reshape(-1, 3) @ rotation.T
    total = torch.zeros(ROWS * COLUMNS, 3).index_add_(0, _cells(towards), power.reshape(-1, 3))
    if suns:
        towards = torch.tensor([sun["direction"] for sun in suns]).float() @ rotation.T
        total.index_add_(0, _cells(towards), torch.tensor([sun["irradiance"] for sun in suns]).float())
    truth = total.reshape(ROWS, COLUMNS, 3) / cell_solid_angles()[..., None]
    return LightExample(name, describe_place(found), truth)


def write_examples(path: Path, examples: Sequence[LightExample]) -> None:
    """Write examples as one compressed .npz of half precision, some 8 KB each."""
    arrays = {
        "version": np.array(VERSION),
        "names": np.array([example.name for example in examples]),
        "maps": _half([example.place.maps for example in examples]),
        "numbers": _half([example.place.numbers for example in examples]),
        # suns reach 10^5, more than half precision holds
        "log2_truth": _half([example.truth.clamp_min(1e-6).log2() for example in examples]),
    }
    with atomic_write(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def read_examples(path: Path) -> list[LightExample]:
    """Read what `write_examples` wrote.

    Raises:
        ValueError: The file is no such file, or of another version.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        version = int(arrays["version"])
        parts = [torch.from_numpy(arrays[name]).float() for name in ("maps", "numbers", "log2_truth")]
        names = [str(name) for name in arrays["names"]]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected examples of light as `synth lights` writes them, found {error}") from error
    if version != VERSION:
        raise ValueError(f"{path}: expected examples of version {VERSION}, found version {version}")
    rows = zip(names, *parts, strict=True)
    return [LightExample(name, PlaceDescription(maps, numbers), truth.exp2()) for name, maps, numbers, truth in rows]


def _cells(towards: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    row = (towards[:, 2].clamp(-1, 1).acos() / math.pi * ROWS).long().clamp_max(ROWS - 1)
    turn = torch.atan2(towards[:, 1], towards[:, 0]) % (2 * math.pi)
    return row * COLUMNS + (turn / (2 * math.pi) * COLUMNS).long().clamp_max(COLUMNS - 1)


def _half(tensors: Sequence[Tensor]) -> np.ndarray:
    return torch.stack(list(tensors)).numpy().astype(np.float16)
