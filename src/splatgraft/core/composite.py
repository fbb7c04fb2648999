"""The value `Composite`: a target scene with objects placed in it. Knows nothing about files, light or rendering."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.similarity import Similarity


@dataclass(frozen=True)
class PlacedObject:
    """An object's Gaussians and where they stand in the target scene."""

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
    """In the order in which they are baked."""
    erased: Bool[Tensor, "n"]
    """True where a Gaussian of the target is left out."""

    def bake(self) -> tuple[Gaussians, Bool[Tensor, "m"]]:
        """One plain scene, kept target first, then the objects in order; and which Gaussians belong to an object."""
        gaussians = self._baked_gaussians()
        return gaussians, torch.arange(gaussians.count, device=gaussians.device) >= self.kept_count

    def object_index(self) -> Int[Tensor, "m"]:
        """For every Gaussian of the baked scene the position of its object in `objects`, or -1 for the target."""
        counts = [self.kept_count] + [placed.gaussians.count for placed in self.objects]
        return torch.repeat_interleave(torch.arange(-1, len(self.objects)), torch.tensor(counts))

    @property
    def kept_count(self) -> int:
        """How many of the target's Gaussians are not erased."""
        return int((~self.erased).sum())

    def with_object_colors(self, recolored: tuple[Gaussians, ...]) -> "Composite":
        """The same placement of objects whose Gaussians are exchanged for `recolored`, in the objects' own frames."""
        pairs = zip(self.objects, recolored, strict=True)
        return replace(self, objects=tuple(replace(placed, gaussians=gaussians) for placed, gaussians in pairs))

    def _baked_gaussians(self) -> Gaussians:
        kept = self.target.select(~self.erased) if bool(self.erased.any()) else self.target
        # an empty object must not even widen the harmonics: it is the identity
        parts = [placed.in_target() for placed in self.objects if placed.gaussians.count]
        return concatenate([kept, *parts]) if parts else kept
