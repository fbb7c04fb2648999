"""The folder of a composite: placement.json, and the baked scene as scene.ply with is_object.npy.

- `relight` reads placement.json and the target's scene.ply, because it needs separate objects and unsplit Gaussians.
- `render`, `evaluate` and other programs read the baked scene.ply; it has no effect on the light transfer.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.composition import Composite, compose
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.project.gaussian_flags import read_flags, write_flags
from splatgraft.project.layout import ERASED_FILE, IS_GUESSED_FILE, IS_OBJECT_FILE, PLACEMENT_FILE, SCENE_FILE
from splatgraft.project.placement import Placement, read_placement, write_placement

_ONE_SIDED = 0.25
"""Offset of the guessed surface, in object radii, above which only one side counts as photographed; set by hand."""


def placement_files(path: Path) -> tuple[Path, ...]:
    """List placement.json and all files that it names."""
    placement = read_placement(path)
    erased = (path.parent / ERASED_FILE,) if placement.erased is not None else ()
    return (path, *erased, *(item.object_path for item in placement.objects if item.object_path is not None))


def read_composite(target: Path, placement: Path) -> Composite:
    """Read the composite of a target scene and the objects that a placement names."""
    found = read_placement(placement)
    for index, item in enumerate(found.objects):
        if item.object_path is None:
            raise ValueError(f'{placement}: expected objects[{index}] to name its "object", found none')
    return composite_of(read_gaussians(target), found)


def composite_of(
    target: Gaussians, placement: Placement, *, known: Mapping[Path, Gaussians] = MappingProxyType({})
) -> Composite:
    """Compose a target scene and the objects that `placement` names; each file is read once.

    `known` holds scenes that were read before, by path.
    """
    read, objects = dict(known), []
    for item in placement.objects:
        assert item.object_path is not None
        if item.object_path not in read:
            read[item.object_path] = read_gaussians(item.object_path)
        objects.append(read[item.object_path])
    moves = [item.target_from_object for item in placement.objects]
    return compose(target, objects, target_from_objects=moves, erased=placement.erased)


def guessed_gaussians(folder: Path, is_object: Bool[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Mark the Gaussians of a composite's scene that close a side of an object that no photograph shows.

    Args:
        folder: Folder of the composite; its placement.json names the objects, which have is_guessed.npy beside them.
        is_object: Mask of the objects' Gaussians in the scene.

    Returns:
        A mask of the scene's Gaussians; all false if an object has no such file, or the files do not fit the scene.
    """
    guessed = torch.zeros_like(is_object)
    if (folder / PLACEMENT_FILE).is_file():
        paths = [item.object_path for item in read_placement(folder / PLACEMENT_FILE).objects]
        files = [path.parent / IS_GUESSED_FILE for path in paths if path is not None]
        flags = [read_flags(file) for file in files if file.is_file()]
        if flags and len(flags) == len(paths) and sum(map(len, flags)) == int(is_object.sum()):
            guessed[is_object] = torch.cat(flags)
    return guessed


def photographed_side(
    scene: Gaussians, is_object: Bool[Tensor, "n"], is_guessed: Bool[Tensor, "n"], up: Float[Tensor, "3"]
) -> Float[Tensor, "3"] | None:
    """Compute the horizontal unit vector from the guessed surface to the object's median; None without a clear side."""
    if not bool(is_guessed.any()):
        return None
    middle = scene.means[is_object].median(0).values
    away = middle - scene.means[is_guessed].mean(0)
    level, radius = away - (away @ up) * up, (scene.means[is_object] - middle).norm(dim=1).quantile(0.9)
    return torch.nn.functional.normalize(level, dim=0) if float(level.norm()) > _ONE_SIDED * float(radius) else None


def write_composite(folder: Path, composite: Composite, placement: Placement) -> None:
    """Write the three files; `placement` describes `composite` and names every object's file."""
    gaussians, is_object = composite.bake()
    write_gaussians(folder / SCENE_FILE, gaussians)
    write_flags(folder / IS_OBJECT_FILE, is_object)
    write_placement(folder / PLACEMENT_FILE, placement)
