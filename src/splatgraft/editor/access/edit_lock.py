"""One window edits, the others look on. Knows nothing about windows but their numbers."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class EditLock:
    """The windows that are open, in the order in which they came, and the one that edits."""

    windows: tuple[int, ...] = ()
    """All of them."""
    holder: int | None = None
    """The one whose clicks count; None where none is open."""

    def joined(self, window: int) -> "EditLock":
        """One more window; the first one edits."""
        return EditLock((*self.windows, window), window if self.holder is None else self.holder)

    def left(self, window: int) -> "EditLock":
        """One window less; where it was the editing one, the oldest that is left edits."""
        rest = tuple(other for other in self.windows if other != window)
        holder = self.holder if self.holder != window else next(iter(rest), None)
        return EditLock(rest, holder)

    def taken(self, window: int) -> "EditLock":
        """That window edits from now on."""
        return replace(self, holder=window) if window in self.windows else self
