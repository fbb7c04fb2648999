"""An unbounded undo and redo history as an immutable value."""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class History(Generic[T]):
    """A present value, all earlier ones, and those that were undone."""

    present: T
    """The current value."""
    past: tuple[T, ...] = ()
    """Earlier values, oldest first."""
    future: tuple[T, ...] = ()
    """Undone values, the most recently undone last."""

    def pushed(self, value: T) -> "History[T]":
        """The history after a new step to `value`; undone values are discarded."""
        return History(value, (*self.past, self.present))

    def amended(self, value: T) -> "History[T]":
        """The history with `value` in place of the present one, without a new step."""
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
