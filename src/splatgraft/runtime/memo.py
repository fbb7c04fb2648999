"""A memo of results by name; a result is reused while its inputs are the same objects."""

from collections.abc import Callable
from typing import Any


class Memo:
    """The latest result of each name, with its inputs."""

    def __init__(self) -> None:
        """Start empty."""
        self._entries: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def get(self, name: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """Return the result of that name if its inputs were the same, otherwise store and return `make()`."""
        entry = self._entries.get(name)
        if entry is None or not same_inputs(entry[0], inputs):
            entry = (inputs, make())
            self.put(name, *entry)
        return entry[1]

    def peek(self, name: str, inputs: tuple[Any, ...]) -> Any | None:
        """Return the result of that name if its inputs were the same, otherwise None."""
        entry = self._entries.get(name)
        return entry[1] if entry is not None and same_inputs(entry[0], inputs) else None

    def put(self, name: str, inputs: tuple[Any, ...], result: Any) -> None:
        """Store `result`, replacing the one of that name."""
        self._entries[name] = (inputs, result)

    def forget(self, name: str) -> None:
        """Discard the result of that name, if any."""
        self._entries.pop(name, None)

    def has(self, name: str) -> bool:
        """Return whether a result of that name is stored, from any inputs."""
        return name in self._entries


def same_inputs(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    """Return whether two tuples hold the same objects; numbers, strings and bytes are compared by value."""
    return len(a) == len(b) and all(
        x is y or (isinstance(x, int | float | str | bytes) and x == y) for x, y in zip(a, b, strict=True)
    )
