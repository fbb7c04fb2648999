"""Sequences whose items are read on access, so that memory holds one at a time."""

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


class LazySequence(Sequence[T]):
    """A sequence of `count` items; every access calls `read(index)`."""

    def __init__(self, count: int, read: Callable[[int], T]) -> None:
        """Store the function without calling it."""
        self._count, self._read = count, read

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> T:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not 0 <= index < self._count:
            raise IndexError(index)
        return self._read(index)
