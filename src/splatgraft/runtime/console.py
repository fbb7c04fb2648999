"""Console output of steps: a progress bar each, or lines without a terminal, and messages of one line."""

import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

import rich.console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from splatgraft.runtime.note import Note
from splatgraft.runtime.progress import Progress

_LINES = 10  # lines per counter of a step without a terminal: one per 10%
_LINE_SECONDS = 1.0  # minimum time between two of these lines


class Console:
    """Messages and bars on standard error, paths of results on standard output."""

    def __init__(self) -> None:
        """Open standard error."""
        self._errors = rich.console.Console(stderr=True, highlight=False)
        self._results = rich.console.Console(highlight=False, soft_wrap=True)
        self._warned: list[Note] = []
        self._said: set[str] = set()

    def say_once(self, sentence: str) -> None:
        """Print one line on standard error, unless it was printed before."""
        if sentence not in self._said:
            self._said.add(sentence)
            self.say(sentence)

    def say(self, sentence: str) -> None:
        """Print one line on standard error."""
        self._errors.print(sentence, markup=False, soft_wrap=True)

    def tell(self, *notes: Note) -> None:
        """Print notes on standard error; warnings of a step also go into its step.json and the report."""
        for note in notes:
            sentence = f"{note.text} {note.remedy}".rstrip()
            self.say(sentence if note.level == "said" else f"warning: {sentence}")
            self._warned += [] if note.level == "said" else [note]

    @contextmanager
    def collecting(self) -> Generator[list[Note]]:
        """Collect the warnings of a step.

        Yields:
            The warnings so far; the list grows.
        """
        outer, self._warned = self._warned, []
        try:
            yield self._warned
        finally:
            self._warned = outer

    def result(self, text: object) -> None:
        """Print one line on standard output."""
        self._results.print(str(text), markup=False)

    @contextmanager
    def bar(self, name: str) -> Generator[Progress]:
        """Show a progress bar; without a terminal a line at the start, per 10% and at the end.

        Yields:
            The function that moves the bar; it takes steps done, steps in all and a short text.
        """
        if not self._errors.is_terminal:
            began = time.monotonic()
            self.say(f"{name:<20} begins")
            yield _Lines(name, self.say)
            self.say(f"{name:<20} done in {time.monotonic() - began:.1f} s")
            return
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[message]}", markup=False),
        )
        with Bars(*columns, console=self._errors) as bars:
            task = bars.add_task(f"{name:<20}", total=None, message="")

            def move(done: int, total: int, message: str) -> None:
                bars.update(task, completed=done, total=total, message=f"{done}/{total} {message}")

            yield move
            shown = bars.tasks[0]
            bars.update(task, total=shown.total or 1, completed=shown.total or 1)


class _Lines:
    """A `Progress` that prints a line per tenth of a counter; a step may count several times."""

    def __init__(self, name: str, say: Callable[[str], None]) -> None:
        self._name, self._say = name, say
        self._last, self._passed, self._printed = (0, 0), 0, time.monotonic()

    def __call__(self, done: int, total: int, message: str) -> None:
        if done < self._last[0] or total != self._last[1]:
            self._passed = 0
        self._last = (done, total)
        passed = _LINES * done // max(total, 1)
        if passed > self._passed and time.monotonic() - self._printed >= _LINE_SECONDS:
            self._say(f"{self._name:<20} {100 * passed // _LINES:3d}%  {done}/{total} {message}".rstrip())
            self._passed, self._printed = passed, time.monotonic()
