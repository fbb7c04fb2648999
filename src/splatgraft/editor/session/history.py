"""Undo and redo without bound, as a value. Knows nothing about what is kept."""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class History(Generic[T]):
    """A present value, all earlier ones, and those that were undone."""

    present: T
    """What counts now."""
    past: tuple[T, ...] = ()
    """Earlier values, oldest first."""
    future: tuple[T, ...] = ()
    """Undone values, the nearest last."""

    def then(self, value: T) -> "History[T]":
        """`value` counts from now on; what was undone before is forgotten."""
        return History(value, (*self.past, self.present))

    def amended(self, value: T) -> "History[T]":
        """`value` in place of the present one, without a step of its own: what nobody asked for cannot be undone."""
        return replace(self, present=value)

    def undone(self) -> "History[T]":
        """One step back; itself where there is none."""
        if not self.past:
            return self
        return History(self.past[-1], self.past[:-1], (*self.future, self.present))

    def redone(self) -> "History[T]":
        """One step forward again; itself where there is none."""
        if not self.future:
            return self
        return History(self.future[-1], (*self.past, self.present), self.future[:-1])
