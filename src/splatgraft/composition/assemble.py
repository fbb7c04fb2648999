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
    """Place objects in a target scene.

    Args:
        target: The scene that receives the objects, n Gaussians.
        objects: The objects, each in the frame of the capture that it comes from.
        target_from_objects: The placement of each object, such as `place_object` finds.
        erased: Gaussians of the target that are left out; none where not given.

    Returns:
        The composite; its parts are kept apart until it is baked.

    Raises:
        ValueError: There is not one transform per object, or `erased` has another length than the target.
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
