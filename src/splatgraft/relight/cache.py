"""Keeps what a transfer needs again when only the object has moved. Knows nothing about what it keeps."""

from collections.abc import Callable
from typing import Any


class RelightCache:
    """Results by name, each valid for the very inputs it was made from."""

    def __init__(self) -> None:
        """Nothing kept yet."""
        self._kept: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def get(self, name: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """The result kept under `name` if it was made from the same objects (`is`), else a new one from `make`."""
        found = self.peek(name, inputs)
        if found is None:
            found = make()
            self._kept[name] = (inputs, found)
        return found

    def peek(self, name: str, inputs: tuple[Any, ...]) -> Any | None:
        """The result kept under `name` if it was made from the same objects, else None."""
        kept = self._kept.get(name)
        if kept is None or len(kept[0]) != len(inputs):
            return None
        return kept[1] if all(a is b for a, b in zip(kept[0], inputs, strict=True)) else None

    def put(self, name: str, inputs: tuple[Any, ...], result: Any) -> None:
        """Keep `result` in place of what was there."""
        self._kept[name] = (inputs, result)
