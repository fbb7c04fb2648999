"""The protocol of training objectives: a network with its loss, predictions and file format."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from splatgraft_paper.training.sources.pair_source import Role

Latents = Mapping[str, Tensor]
"""Latents (b c h w) by role."""
Network = Callable[..., Any]
"""The objective's network, as it is called: spread over processes, in 16 bits."""


@runtime_checkable
class Objective(Protocol):
    """A network and the task that it is trained for."""

    network: Any
    """A torch module; frozen parameters have requires_grad off."""
    roles: tuple[Role, ...]
    """Images of a pair that the loss needs."""
    output_role: Role
    """The image that the network learns to generate."""

    def encode(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Encode sRGB images in [0, 1] to latents."""
        ...

    def to(self, device: Any) -> None:
        """Move the frozen parts to a device."""
        ...

    def loss(self, network: Network, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """Compute the loss of a batch.

        Args:
            network: `self.network`, or what calls it.
            latents: of the batch, for all `roles`.
            seeds: of the noise, one per pair.
        """
        ...

    def predict(self, network: Network, latents: Latents, seed: int) -> Float[Tensor, "b 3 h w"]:
        """Generate the images of a batch, sRGB in [0, 1]."""
        ...

    def save(self, state: dict[str, Tensor], folder: Path) -> None:
        """Write exactly the weights `state` in the format that inference loads."""
        ...
