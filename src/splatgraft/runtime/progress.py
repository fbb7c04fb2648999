"""Interfaces for progress and checkpoints of long stages."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and a short text such as 'psnr 27.1 dB, 41k Gaussians'."""


def silent(done: int, total: int, message: str) -> None:
    """Report nothing; a `Progress`."""


@runtime_checkable
class Checkpoint(Protocol):
    """Storage for the state of a long stage: tensors, numbers and nested dicts of them."""

    def load(self) -> dict[str, Any] | None:
        """Return the state last saved for the same job with the same inputs, or None."""
        ...

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state atomically."""
        ...


class NoCheckpoint:
    """A `Checkpoint` that stores nothing."""

    def load(self) -> dict[str, Any] | None:
        """Return None."""
        return None

    def save(self, state: dict[str, Any]) -> None:
        """Discard `state`."""
