"""Exponential moving average of a network's trainable parameters."""

from collections.abc import Generator
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class MovingAverage:
    """A float32 moving average of the trainable parameters; it is split over processes as they are."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        """Start from the current weights; `decay` in [0, 1)."""
        self._decay = decay
        self._parameters = {name: p for name, p in network.named_parameters() if p.requires_grad}
        self._averages = {name: p.detach().float().clone() for name, p in self._parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """Move by 1 - decay towards the current weights."""
        for name, parameter in self._parameters.items():
            self._averages[name].lerp_(parameter.detach().float(), 1 - self._decay)

    @contextmanager
    def applied(self) -> Generator[None]:
        """Put the averages into the network within the context."""
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    def state_dict(self) -> dict[str, Tensor]:
        """The averages by parameter name."""
        return self._averages

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name, tensor in state.items():
            self._averages[name].copy_(tensor)

    @torch.no_grad()
    def _exchange(self) -> None:
        """Exchange weights and averages; one parameter at a time, so that no third copy of the weights is needed."""
        for name, parameter in self._parameters.items():
            current = parameter.detach().clone()
            parameter.copy_(self._averages[name])
            self._averages[name].copy_(current)
