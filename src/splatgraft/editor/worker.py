"""A worker thread that processes only the newest request and discards older waiting ones."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")
_JOIN_SECONDS = 1.0


class LatestOnlyWorker(Generic[T]):
    """A thread with at most one waiting request."""

    def __init__(self, work: Callable[[T], None], on_error: Callable[[Exception], None]) -> None:
        """Start the thread, which calls `work` with one request at a time, and `on_error` if that raises."""
        self._work, self._on_error = work, on_error
        self._waiting: list[T] = []
        self._wake = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name="splatgraft preview", daemon=True)
        self._thread.start()

    def submit(self, request: T) -> None:
        """Process `request` after the current one; it replaces any waiting request."""
        with self._wake:
            self._waiting = [request]
            self._wake.notify()

    def wait_idle(self, seconds: float) -> bool:
        """Wait at most `seconds` for a newer request; return whether none arrived."""
        with self._wake:
            return not self._wake.wait_for(lambda: bool(self._waiting) or not self._open, timeout=seconds)

    def close(self) -> None:
        """Discard the waiting request and stop the thread after the current one, which may outlast this call."""
        with self._wake:
            self._open, self._waiting = False, []
            self._wake.notify()
        self._thread.join(timeout=_JOIN_SECONDS)

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: bool(self._waiting) or not self._open)
                if not self._open:
                    return
                request = self._waiting.pop()
            try:
                self._work(request)
            except Exception as error:  # one failed request must not end the thread
                if self._open:  # else the target of its output may be gone
                    self._on_error(error)
