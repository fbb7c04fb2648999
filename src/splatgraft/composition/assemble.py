"""Builds a `Composite` from a target, objects, their transforms and the Gaussians to erase, and checks them."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity


def compose(
    target: Gaussians,
    objects: Sequence[Gaussians],
    *,
    target_from_objects: Sequence[Similarity],
    erased: Bool[Tensor, "n"] | None = None,
) -> Composite:
    """Place each of `objects` in `target` by its transform.

    Args:
        target: The receiving scene.
        objects: Each in the frame of its own capture.
        target_from_objects: One transform per object.
        erased: True for Gaussians of the target to leave out; None leaves out none.

    Raises:
        ValueError: Where there is not one transform per object, or `erased` has another length than the target.
    """
    if len(objects) != len(target_from_objects):
        raise ValueError(f"placement: expected {len(objects)} objects, one per .ply, found {len(target_from_objects)}")
    if erased is None:
        erased = torch.zeros(target.count, dtype=torch.bool, device=target.device)
    if len(erased) != target.count:
        raise ValueError(f"erased: expected one flag for each of {target.count} Gaussians, found {len(erased)}")
    pairs = zip(objects, target_from_objects, strict=True)
    placed = tuple(PlacedObject(gaussians=g, target_from_object=t) for g, t in pairs)
    return Composite(target=target, objects=placed, erased=erased)
