"""Exponential moving average of a network's trainable parameters."""

from collections.abc import Generator
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class MovingAverage:
    """A float32 moving average of the trainable parameters."""

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
        current = {name: p.detach().clone() for name, p in self._parameters.items()}
        self._set(self._averages)
        try:
            yield
        finally:
            self._set(current)

    def state_dict(self) -> dict[str, Tensor]:
        """The averages by parameter name."""
        return self._averages

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name, tensor in state.items():
            self._averages[name].copy_(tensor)

    @torch.no_grad()
    def _set(self, values: dict[str, Tensor]) -> None:
        for name, parameter in self._parameters.items():
            parameter.copy_(values[name])
