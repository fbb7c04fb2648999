"""A later capture by a second process, while this one makes the first.

Half of structure from motion runs on one core (mapping and refinement), so two captures at once take little longer than
one. `python -m splatgraft.workflow.capture_ahead PROJECT OUT STEP` is the second process.
"""

import os
import subprocess
import sys
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Queue

from splatgraft.editor.jobs import PlannedStep
from splatgraft.project.step import perform
from splatgraft.runtime.console import Console
from splatgraft.steps.capture import Capture
from splatgraft.workflow.flow import Flow, read_flow

_WORTHWHILE_SECONDS = 20.0  # expected time of a capture from which a process is worth its start


class CaptureAhead:
    """A step that another process performs."""

    def __init__(self, project: Path, out: Path | None, name: str) -> None:
        """Start the process; it ends with this one, because its standard input then closes."""
        self.name = name
        command = [sys.executable, "-m", __spec__.name, str(project), "" if out is None else str(out), name]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, errors="replace"
        )
        self._lines: Queue[str] = Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._lines.put(line)
        self._lines.put("")

    def finish(self, console: Console) -> None:
        """Print the messages of the process until it ends; a failure is left to the step's own error."""
        while line := self._lines.get():
            console.say(line.rstrip())
        self.process.wait()

    def stop(self) -> None:
        """End the process; a later run continues what it left."""
        self.process.terminate()
        self.process.wait()
        self._reader.join()
        for stream in (self.process.stdin, self.process.stderr):
            if stream is not None:
                stream.close()


@contextmanager
def captures_ahead(
    flow: Flow, project: Path, out: Path | None, planned: Sequence[PlannedStep]
) -> Generator[dict[str, CaptureAhead]]:
    """Begin all planned captures but the first if each takes long enough; at the end, those still running are stopped.

    Yields:
        The begun captures by name.
    """
    steps = dict(flow)
    long = [one.name for one in planned if isinstance(steps[one.name], Capture) and one.seconds > _WORTHWHILE_SECONDS]
    begun: dict[str, CaptureAhead] = {}
    try:
        for name in long[1:]:
            begun[name] = CaptureAhead(project, out, name)
        yield begun
    finally:
        for one in begun.values():
            one.stop()


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


def main(project: str, out: str, name: str) -> None:
    """Perform one step of a project."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    perform(read_flow(Path(project), Path(out) if out else None).steps[name], Console(), name=name)


if __name__ == "__main__":
    main(*sys.argv[1:])
