"""Images that are read when asked for, so that memory holds one. Knows nothing about where they come from."""

from collections.abc import Callable, Sequence

from torch import Tensor


class LazySequence(Sequence[Tensor]):
    """`count` images, each made by `read(index)` whenever it is asked for."""

    def __init__(self, count: int, read: Callable[[int], Tensor]) -> None:
        """Nothing is read yet."""
        self._count, self._read = count, read

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not 0 <= index < self._count:
            raise IndexError(index)
        return self._read(index)
