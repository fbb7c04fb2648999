"""The value `Composite`: a target scene with objects placed in it, and its conversion to one plain scene."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.contact import flatten_contact_layers
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.core.splitting import split_wide_around


@dataclass(frozen=True)
class PlacedObject:
    """An object's Gaussians and their place in the target scene."""

    gaussians: Gaussians
    """In the frame of the capture that the object comes from."""
    target_from_object: Similarity
    """From that frame to the target's."""

    def in_target(self) -> Gaussians:
        """The object's Gaussians in the target's frame."""
        return self.target_from_object.gaussians(self.gaussians)


@dataclass(frozen=True)
class Composite:
    """A target scene, the objects placed in it, and which of the target's Gaussians are erased."""

    target: Gaussians
    """The scene that receives the objects, n Gaussians."""
    objects: tuple[PlacedObject, ...]
    """In the order in which they follow the target in a merged or baked scene."""
    erased: Bool[Tensor, "n"]
    """True where a Gaussian of the target is left out."""

    def bake(self) -> tuple[Gaussians, Bool[Tensor, "b"]]:
        """The scene to write or to draw, and which of its Gaussians belong to an object.

        Wide Gaussians of the target around the objects are split, so that they do not cover the objects' edges.
        """
        return split_wide_around(*self.merged(), [placed.in_target() for placed in self.objects])

    def merged(self) -> tuple[Gaussians, Bool[Tensor, "m"]]:
        """The target's kept Gaussians, then the objects' in order, none split; and which belong to an object.

        What an object stands on is flattened around its foot, so that it does not cover it.
        """
        kept = self.target.select(~self.erased) if bool(self.erased.any()) else self.target
        # an empty object must not even widen the harmonics: it is the identity
        parts = [placed.in_target() for placed in self.objects if placed.gaussians.count]
        gaussians = concatenate([flatten_contact_layers(kept, parts), *parts]) if parts else kept
        return gaussians, torch.arange(gaussians.count, device=gaussians.device) >= self.kept_count

    @property
    def kept_count(self) -> int:
        """How many of the target's Gaussians are not erased."""
        return int((~self.erased).sum())

    def with_object(self, gaussians: Gaussians, target_from_object: Similarity) -> "Composite":
        """The composite with one more object, after the others."""
        return replace(self, objects=(*self.objects, PlacedObject(gaussians, target_from_object)))

    def with_object_colors(self, recolored: tuple[Gaussians, ...]) -> "Composite":
        """The composite with `recolored`, in the objects' own frames, in place of the objects' Gaussians."""
        pairs = zip(self.objects, recolored, strict=True)
        return replace(self, objects=tuple(replace(placed, gaussians=gaussians) for placed, gaussians in pairs))
