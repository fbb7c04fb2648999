"""Reads large scenes in the background while the page shows samples of them and takes input."""

import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from splatgraft.editor.session.session import Session


class SceneLoading:
    """The scenes that are being read."""

    def __init__(self, on_read: Callable[[], None]) -> None:
        """Read nothing yet; `on_read` is called in a thread when scenes are there, or could not be read."""
        self._on_read = on_read
        self._lock = threading.Lock()
        self._reading: set[Path] = set()
        self._failed: set[Path] = set()

    def has(self, session: Session, paths: Iterable[Path]) -> bool:
        """Whether scenes are at hand; those that are not are read in the background.

        A file that could not be read counts as at hand, so that whoever uses it reports what is wrong with it.
        """
        missing = [path for path in dict.fromkeys(paths) if not session.scenes.is_at_hand(path)]
        with self._lock:
            missing = [path for path in missing if path not in self._failed]
            started = [path for path in missing if path not in self._reading]
            self._reading |= set(started)
        for path in started:
            # a thread for each, so that a small object does not wait for a large scene
            arguments = (session, path)
            threading.Thread(target=self._read, args=arguments, name="splatgraft scene", daemon=True).start()
        return not missing

    def _read(self, session: Session, path: Path) -> None:
        try:
            session.scenes.gaussians(path)
        except (ValueError, OSError, MemoryError):
            with self._lock:
                self._failed.add(path)
        with self._lock:
            self._reading.discard(path)
        self._on_read()
