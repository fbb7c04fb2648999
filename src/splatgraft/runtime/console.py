"""What a person sees while steps run: one bar per step and plain sentences. Knows nothing about what the steps do."""

from collections.abc import Generator
from contextlib import contextmanager

import rich.console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from splatgraft.runtime.progress import Progress


class Console:
    """Speaks on standard error; standard output is for the paths of results."""

    def __init__(self) -> None:
        """Open standard error."""
        self._errors = rich.console.Console(stderr=True, highlight=False)
        self._results = rich.console.Console(highlight=False, soft_wrap=True)

    def say(self, sentence: str) -> None:
        """One line for the person who waits."""
        self._errors.print(sentence, markup=False, soft_wrap=True)

    def result(self, text: object) -> None:
        """One line for whoever reads standard output."""
        self._results.print(str(text), markup=False)

    @contextmanager
    def bar(self, name: str) -> Generator[Progress]:
        """A bar called `name` that the given function moves; where there is no terminal, one line at the end."""
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
