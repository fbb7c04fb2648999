"""Results by name, each as long as what it was made of stays the same. Knows nothing about what they are."""

from collections.abc import Callable
from typing import Any


class Memo:
    """At most one result per name."""

    def __init__(self) -> None:
        """Nothing yet."""
        self._made: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def get(self, name: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """The result of that name if it was made of these inputs, else a new one."""
        made = self._made.get(name)
        if made is None or not same_inputs(made[0], inputs):
            made = (inputs, make())
            self.put(name, *made)
        return made[1]

    def peek(self, name: str, inputs: tuple[Any, ...]) -> Any | None:
        """The result of that name if it was made of these inputs, else None."""
        made = self._made.get(name)
        return made[1] if made is not None and same_inputs(made[0], inputs) else None

    def put(self, name: str, inputs: tuple[Any, ...], result: Any) -> None:
        """Keep `result` in place of what was there."""
        self._made[name] = (inputs, result)

    def has(self, name: str) -> bool:
        """Whether there is one of that name, of whatever inputs."""
        return name in self._made


def same_inputs(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    """Whether two lists of inputs are the very same objects; numbers, texts and bytes count by value."""
    return len(a) == len(b) and all(
        x is y or (isinstance(x, int | float | str | bytes) and x == y) for x, y in zip(a, b, strict=True)
    )
