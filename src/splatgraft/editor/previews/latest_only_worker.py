"""One worker that does the newest request and forgets those it had no time for. Knows nothing about the work."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestOnlyWorker(Generic[T]):
    """A thread with at most one request waiting."""

    def __init__(self, work: Callable[[T], None], failed: Callable[[Exception], None]) -> None:
        """Start the thread; `work` gets one request at a time, `failed` what it raises."""
        self._work, self._failed = work, failed
        self._waiting: list[T] = []
        self._wake = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def ask(self, request: T) -> None:
        """Do this as soon as the present one is done, in place of any that waits."""
        with self._wake:
            self._waiting = [request]
            self._wake.notify()

    @property
    def overtaken(self) -> bool:
        """Whether a newer request waits: long work may stop here."""
        return bool(self._waiting)

    def idle(self, seconds: float) -> bool:
        """Whether no newer request came for so long: time for work that cannot be stopped."""
        with self._wake:
            return not self._wake.wait_for(lambda: bool(self._waiting) or not self._open, timeout=seconds)

    def close(self) -> None:
        """Let the present one end, then stop."""
        with self._wake:
            self._open, self._waiting = False, []
            self._wake.notify()
        self._thread.join(timeout=10)

    def _run(self) -> None:
        while True:
            with self._wake:
                while self._open and not self._waiting:
                    self._wake.wait()
                if not self._open:
                    return
                request = self._waiting.pop()
            try:
                self._work(request)
            except Exception as error:  # a picture that fails must not end the thread that makes all others
                self._failed(error)
