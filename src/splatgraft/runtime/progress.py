"""How a long stage says how far it is and saves what it needs to go on. Knows nothing about terminals or files."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and a short text such as 'psnr 27.1 dB, 41k Gaussians'."""


def silent(done: int, total: int, message: str) -> None:
    """A `Progress` that tells nobody."""


@runtime_checkable
class Checkpoint(Protocol):
    """Where a long stage leaves its state (tensors, numbers, nested dicts of them) and finds it again."""

    def load(self) -> dict[str, Any] | None:
        """The last state saved for this very job, or None."""
        ...

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state, whole or not at all."""
        ...


class NoCheckpoint:
    """A `Checkpoint` that keeps nothing."""

    def load(self) -> dict[str, Any] | None:
        """Nothing was ever saved."""
        return None

    def save(self, state: dict[str, Any]) -> None:
        """Forget."""
