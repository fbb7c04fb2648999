"""Things that are read when asked for, so that memory holds one at a time. Knows nothing about what they are."""

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


class LazySequence(Sequence[T]):
    """`count` things, each made by `read(index)` whenever it is asked for."""

    def __init__(self, count: int, read: Callable[[int], T]) -> None:
        """Nothing is read yet."""
        self._count, self._read = count, read

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> T:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not 0 <= index < self._count:
            raise IndexError(index)
        return self._read(index)
