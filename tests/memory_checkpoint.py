"""A checkpoint in memory, and the error by which tests interrupt what saves to it."""

from typing import Any

import torch


class KilledError(Exception):
    """Raised by a test where a process would be killed."""


class MemoryCheckpoint:
    """A `Checkpoint` that holds a copy of the last state."""

    def __init__(self) -> None:
        """Nothing saved."""
        self.state: Any = None

    def load(self) -> dict[str, Any] | None:
        """The last state."""
        return self.state

    def save(self, state: dict[str, Any]) -> None:
        """Keep a copy of `state`."""
        self.state = _copy(state)


def _copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor) else value
