"""The edit lock: of all open windows one edits, the others are read-only."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class EditLock:
    """The open windows and the one that holds the lock."""

    windows: tuple[int, ...] = ()
    """Numbers of the open windows, oldest first."""
    holder: int | None = None
    """The window that edits; None where no window is open."""

    def with_window(self, window: int) -> "EditLock":
        """The lock after `window` opened; the first window takes it."""
        return EditLock((*self.windows, window), window if self.holder is None else self.holder)

    def without_window(self, window: int) -> "EditLock":
        """The lock after `window` closed; the oldest remaining window takes it if `window` held it."""
        rest = tuple(other for other in self.windows if other != window)
        holder = self.holder if self.holder != window else next(iter(rest), None)
        return EditLock(rest, holder)

    def held_by(self, window: int) -> "EditLock":
        """The lock after `window` took it; unchanged where that window is not open."""
        return replace(self, holder=window) if window in self.windows else self
