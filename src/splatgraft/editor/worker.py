"""A worker thread that does only the newest work and discards older waiting work."""

import threading
from collections.abc import Callable

Work = Callable[[], object]
_JOIN_SECONDS = 1.0


class LatestOnlyWorker:
    """A thread with at most one waiting piece of work."""

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        """Start the thread, which calls `on_error` with what a piece of work raises."""
        self._on_error, self._waiting = on_error, list[Work]()
        self._wake = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name="splatgraft preview", daemon=True)
        self._thread.start()

    def submit(self, work: Work) -> None:
        """Do `work` after the current one; it replaces what waits."""
        with self._wake:
            self._waiting = [work]
            self._wake.notify()

    def wait_idle(self, seconds: float) -> bool:
        """Wait at most `seconds` for newer work; return whether none arrived."""
        with self._wake:
            return not self._wake.wait_for(lambda: bool(self._waiting) or not self._open, timeout=seconds)

    def close(self) -> None:
        """Discard what waits, and stop the thread after the current work, which may outlast this call."""
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
                work = self._waiting.pop()
            try:
                work()
            except Exception as error:  # a failure must not end the thread
                if self._open:  # else the target of its output may be gone
                    self._on_error(error)
