"""A checkpoint in memory, and the error by which tests interrupt the code that saves to it."""

from typing import Any

import torch


class KilledError(Exception):
    """Error that a test raises in place of a kill."""


class MemoryCheckpoint:
    """`Checkpoint` that holds a copy of the last state."""

    def __init__(self) -> None:
        """Begin without a state."""
        self.state: Any = None

    def load(self) -> dict[str, Any] | None:
        """Return the last state."""
        return self.state

    def save(self, state: dict[str, Any]) -> None:
        """Keep a copy of `state`."""
        self.state = _copy(state)


def _copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor) else value
