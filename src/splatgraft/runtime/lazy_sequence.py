"""Sequences whose items are read on access, so that memory holds one at a time."""

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


class LazySequence(Sequence[T]):
    """`count` items, each read anew by `read(index)` on every access."""

    def __init__(self, count: int, read: Callable[[int], T]) -> None:
        """Read nothing yet."""
        self._count, self._read = count, read

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> T:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not 0 <= index < self._count:
            raise IndexError(index)
        return self._read(index)
