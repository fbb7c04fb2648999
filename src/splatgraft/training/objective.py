"""What a training is of: a network, its loss, what it shows and how it is kept. Knows no loop and no files' names."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.training.sources.pair_source import Role

Latents = Mapping[str, Tensor]
"""By role, (b c h w) each."""


@runtime_checkable
class Objective(Protocol):
    """One network and what it learns."""

    network: Any
    """A torch module; what does not learn has requires_grad off."""
    roles: tuple[Role, ...]
    """Pictures of a pair that it is given."""
    shown: Role
    """The picture that it learns to make."""

    def encode(self, pictures: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Latents of pictures, in [0, 1]."""
        ...

    def to(self, device: Any) -> None:
        """Bring all that does not learn to a device."""
        ...

    def loss(self, network: nn.Module, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """Of a batch, with the noise of these seeds; `network` is the one that the loop has wrapped."""
        ...

    def predict(self, network: nn.Module, latents: Latents, seed: int) -> Float[Tensor, "b 3 h w"]:
        """What the network now makes of a batch."""
        ...

    def save(self, state: dict[str, Tensor], folder: Path) -> None:
        """Write the network with these weights, so that it can be used."""
        ...
