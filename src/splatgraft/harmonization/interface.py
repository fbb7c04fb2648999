"""What every harmoniser takes and gives: the pictures of one view. Knows nothing about models or weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class HarmonizerInputs:
    """The pictures of one view of a composite."""

    composite: Float[Tensor, "h w 3"]
    """The object pasted in as it was captured, sRGB in [0, 1]."""
    background: Float[Tensor, "h w 3"]
    """The target scene without the object, sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """How much of each pixel the object covers, in [0, 1]."""
    depth: Float[Tensor, "h w"]
    """Distance of the composite along the optical axis, world units of the target; 0 where nothing is hit."""
    normal: Float[Tensor, "h w 3"]
    """Unit normal of the composite towards the camera, in the target's world; 0 where nothing is hit."""
    prior: Float[Tensor, "h w 3"]
    """The composite after light transfer, sRGB in [0, 1]; equal to `composite` where none was done."""
    prior_confidence: float = 0.0
    """How far the light behind `prior` may be believed, in [0, 1]; 0 where there was no transfer."""
    camera_from_world: Float[Tensor, "3 3"] | None = None
    """The camera's rotation (right, down, away); None where the normals are in the camera's frame already."""


@dataclass(frozen=True)
class Harmonized:
    """What a harmoniser says about one view."""

    image: Float[Tensor, "h w 3"]
    """The view with the light made to agree, sRGB in [0, 1]."""
    confidence: Float[Tensor, "h w"] | None = None
    """How far each pixel may be trusted, in [0, 1]; None where the harmoniser does not say."""


@runtime_checkable
class Harmonizer(Protocol):
    """Makes the light of one view agree."""

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """The harmonised image of `view`, of the same size."""
        ...


@runtime_checkable
class BatchHarmonizer(Protocol):
    """A harmoniser that is faster on several views of one size at a time."""

    views_at_once: int
    """How many."""

    def harmonize_all(self, views: Sequence[HarmonizerInputs]) -> list[Harmonized]:
        """The harmonised images of `views`, in their order."""
        ...
