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
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.place_description import (
    COLUMNS,
    ROWS,
    PlaceDescription,
    cell_directions,
    cell_of,
    cell_solid_angles,
    describe_place,
    upright_from_world,
)
from splatgraft.relighting.light.surroundings import DIRECTIONS
from splatgraft.relighting.light.true_light import panorama_pixels
from splatgraft.runtime.atomic_file import atomic_write

VERSION = 3
"""Of the description; examples of another version are refused."""
_DARKEST = 1e-6
"""Radiance or irradiance; darker is kept as this."""


@dataclass(frozen=True)
class CellLight:
    """Light in the cells of a description."""

    radiance: Float[Tensor, "12 24 3"]
    """Mean linear radiance in each cell."""
    irradiance: Float[Tensor, "12 24 3"]
    """On planes whose normals are the cells' middles, from the light itself, not from its cells."""


@dataclass(frozen=True)
class LightExample:
    """One place."""

    name: str
    """Of the scene and the place in it; examples of one scene share what stands before the slash."""
    place: PlaceDescription
    truth: "CellLight"
    """With suns, at the exposure of the pictures."""
    estimated: "CellLight"
    """The estimate that the description shows."""

    @property
    def scene(self) -> str:
        """By which examples are held out together."""
        return self.name.partition("/")[0]

    @property
    def side(self) -> str:
        """SCENE/old or SCENE/new: other lights of it are mixtures of the same lamps."""
        return self.name.rstrip("0123456789")


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
    towards = [directions.reshape(-1, 3)]
    power = [(panorama * solid_angles[..., None]).reshape(-1, 3)]
    if suns:
        towards.append(torch.tensor([sun["direction"] for sun in suns]).float())
        power.append(torch.tensor([sun["irradiance"] for sun in suns]).float())
    truth = _cell_light(torch.cat(towards) @ rotation.T, torch.cat(power))
    radiance = found.hidden.radiance(found.evidence, found.tint)
    estimated = _cell_light(DIRECTIONS @ rotation.T, radiance * (4 * math.pi / len(DIRECTIONS)))
    return LightExample(name, describe_place(found), truth, estimated)


def _cell_light(towards: Float[Tensor, "n 3"], power: Float[Tensor, "n 3"]) -> CellLight:
    """Of light from upright directions, radiance times solid angle."""
    total = torch.zeros(ROWS * COLUMNS, 3).index_add_(0, cell_of(towards), power.float())
    normals = cell_directions().reshape(-1, 3)
    irradiance = (normals @ towards.T).clamp_min(0) @ power.float()
    shape = (ROWS, COLUMNS, 3)
    return CellLight(total.reshape(shape) / cell_solid_angles()[..., None], irradiance.reshape(shape))


def write_examples(path: Path, examples: Sequence[LightExample]) -> None:
    """Write examples as one compressed .npz of half precision, some 12 KB each."""
    arrays = {
        "version": np.array(VERSION),
        "names": np.array([example.name for example in examples]),
        "maps": _half([example.place.maps for example in examples]),
        "numbers": _half([example.place.numbers for example in examples]),
        # suns reach 10^5, more than half precision holds
        "log2_light": _half([_log_light(example) for example in examples]),
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
        parts = [torch.from_numpy(arrays[name]).float() for name in ("maps", "numbers", "log2_light")]
        names = [str(name) for name in arrays["names"]]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected examples of light as `synth lights` writes them, found {error}") from error
    if version != VERSION:
        raise ValueError(f"{path}: expected examples of version {VERSION}, found version {version}")
    rows = zip(names, *parts, strict=True)
    return [
        LightExample(name, PlaceDescription(maps, numbers), CellLight(*light[:2]), CellLight(*light[2:]))
        for name, maps, numbers, light in ((*row[:3], row[3].exp2()) for row in rows)
    ]


def _log_light(example: LightExample) -> Float[Tensor, "4 12 24 3"]:
    parts = [part for light in (example.truth, example.estimated) for part in (light.radiance, light.irradiance)]
    return torch.stack(parts).clamp_min(_DARKEST).log2()


def _half(tensors: Sequence[Tensor]) -> np.ndarray:
    return torch.stack(list(tensors)).numpy().astype(np.float16)
