"""The value `Composite`: a target scene with objects placed in it, and its conversion to one plain scene."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.compositing.contact import flatten_contact_layers
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.core.splitting import split_wide_around
from splatgraft.runtime.notebook import draw_in_notebook


@dataclass(frozen=True)
class PlacedObject:
    """An object's Gaussians and their place in the target scene."""

    gaussians: Gaussians
    """Gaussians in the frame of the object's capture."""
    target_from_object: Similarity
    """Transform from that frame to the target's."""

    def in_target(self) -> Gaussians:
        """Transform the object's Gaussians to the target's frame."""
        return self.target_from_object.gaussians(self.gaussians)


@dataclass(frozen=True)
class Composite:
    """A target scene, the objects placed in it, and a mask of erased Gaussians."""

    target: Gaussians
    """Scene that receives the objects, n Gaussians."""
    objects: tuple[PlacedObject, ...]
    """Objects in the order in which they follow the target in a merged or baked scene."""
    erased: Bool[Tensor, "n"]
    """Mask of the target's Gaussians that are left out."""

    def __repr__(self) -> str:
        objects = " and ".join(f"{placed.gaussians.count:,}" for placed in self.objects) or "none"
        return f"Composite(target of {self.kept_count:,} Gaussians, objects of {objects})"

    _repr_png_ = draw_in_notebook

    def bake(self) -> tuple[Gaussians, Bool[Tensor, "b"]]:
        """Make the scene to write or to draw; returns it and a mask of the objects' Gaussians.

        Wide Gaussians of the target around the objects are split, so that they do not cover the objects' edges.
        """
        return split_wide_around(*self.merged(), [placed.in_target() for placed in self.objects])

    def merged(self) -> tuple[Gaussians, Bool[Tensor, "m"]]:
        """Join the target's kept Gaussians and the objects', none split; returns them and a mask of the objects'.

        The support of an object is flattened around its foot, so that the foot stays visible.
        """
        kept = self.target.select(~self.erased) if bool(self.erased.any()) else self.target
        # an empty object is left out, because it could raise the degree of the harmonics
        parts = [placed.in_target() for placed in self.objects if placed.gaussians.count]
        gaussians = concatenate([flatten_contact_layers(kept, parts), *parts]) if parts else kept
        return gaussians, torch.arange(gaussians.count, device=gaussians.device) >= self.kept_count

    @property
    def kept_count(self) -> int:
        """Number of the target's Gaussians that are not erased."""
        return int((~self.erased).sum())

    def with_object(self, gaussians: Gaussians, target_from_object: Similarity) -> "Composite":
        """Add one object after the others."""
        return replace(self, objects=(*self.objects, PlacedObject(gaussians, target_from_object)))

    def with_object_colors(self, recolored: tuple[Gaussians, ...]) -> "Composite":
        """Replace the objects' Gaussians by `recolored`, given in the objects' own frames."""
        pairs = zip(self.objects, recolored, strict=True)
        return replace(self, objects=tuple(replace(placed, gaussians=gaussians) for placed, gaussians in pairs))
