"""Inputs and outputs of all harmonisers, and the protocols that they implement."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class HarmonizerInputs:
    """The images of one view of a composite scene, all of one size."""

    composite: Float[Tensor, "h w 3"]
    """The object pasted in as it was captured, sRGB in [0, 1]."""
    background: Float[Tensor, "h w 3"]
    """The target scene without the object, sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """Coverage of each pixel by the object, in [0, 1]."""
    depth: Float[Tensor, "h w"]
    """Distance of the composite along the optical axis, world units of the target; 0 where nothing is hit."""
    prior: Float[Tensor, "h w 3"]
    """The composite after light transfer, sRGB in [0, 1]; equal to `composite` without a transfer."""


@runtime_checkable
class Harmonizer(Protocol):
    """An image model that harmonises one view at a time."""

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Harmonise `view`; the image has the same size, sRGB in [0, 1]."""
        ...


@dataclass(frozen=True)
class HarmonizerContext:
    """Device and workload of a harmoniser."""

    device: torch.device = torch.device("cpu")  # noqa: RUF009
    """Device of the network."""
    views: int = 1
    """Number of views that will be harmonised; it decides the price of a service."""
    pixels: int = 704 * 496
    """Pixels per view; they decide the memory of a network."""
    strengths: tuple[float, ...] = (1.0,)
    """Noise levels in (0, 1] from which views will be started."""
    say: Callable[[str], None] = lambda sentence: None
    """Function that takes messages for the user, one line each."""
