"""An exponential moving average of what learns. Knows nothing about loops."""

from collections.abc import Generator
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class MovingAverage:
    """A float32 copy of the learning parameters that follows them slowly."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        """Begin at the weights as they are."""
        self._decay = decay
        self._parameters = {name: p for name, p in network.named_parameters() if p.requires_grad}
        self.shadow = {name: p.detach().float().clone() for name, p in self._parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """One step towards the weights as they are now."""
        for name, parameter in self._parameters.items():
            self.shadow[name].lerp_(parameter.detach().float(), 1 - self._decay)

    @contextmanager
    def applied(self) -> Generator[None]:
        """The network with the averaged weights."""
        kept = {name: p.detach().clone() for name, p in self._parameters.items()}
        self._set(self.shadow)
        try:
            yield
        finally:
            self._set(kept)

    def state_dict(self) -> dict[str, Tensor]:
        """For the state from which a run goes on."""
        return self.shadow

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from there."""
        for name, tensor in state.items():
            self.shadow[name].copy_(tensor)

    @torch.no_grad()
    def _set(self, values: dict[str, Tensor]) -> None:
        for name, parameter in self._parameters.items():
            parameter.copy_(values[name])
