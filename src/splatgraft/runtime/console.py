"""Console output while steps run: one progress bar per step and messages of one line."""

from collections.abc import Generator
from contextlib import contextmanager

import rich.console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from splatgraft.runtime.progress import Progress


class Console:
    """Messages and bars on standard error, paths of results on standard output."""

    def __init__(self) -> None:
        """Open standard error."""
        self._errors = rich.console.Console(stderr=True, highlight=False)
        self._results = rich.console.Console(highlight=False, soft_wrap=True)

    def say(self, sentence: str) -> None:
        """Print one line on standard error."""
        self._errors.print(sentence, markup=False, soft_wrap=True)

    def result(self, text: object) -> None:
        """Print one line on standard output."""
        self._results.print(str(text), markup=False)

    @contextmanager
    def bar(self, name: str) -> Generator[Progress]:
        """Show a progress bar; without a terminal, one line at its end.

        Yields:
            The function that moves the bar: steps done, steps in all, and a short text.
        """
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
