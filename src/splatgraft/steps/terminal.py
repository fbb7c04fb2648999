"""What a person sees while steps run: one bar per step and plain sentences. Knows nothing about what the steps do."""

from collections.abc import Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from splatgraft.progress import Progress


class Terminal:
    """Speaks on standard error; standard output is for the paths of results."""

    def __init__(self) -> None:
        """Open standard error."""
        self._errors = Console(stderr=True, highlight=False)
        self._results = Console(highlight=False, soft_wrap=True)

    def say(self, sentence: str) -> None:
        """One line for the person who waits."""
        self._errors.print(sentence, markup=False, soft_wrap=True)

    def result(self, text: object) -> None:
        """One line for whoever reads standard output."""
        self._results.print(str(text), markup=False)

    def print(self, renderable: object) -> None:
        """A table or text for standard output."""
        self._results.print(renderable)

    @contextmanager
    def bar(self, name: str) -> Generator[Progress]:
        """A bar called `name` that the given function moves; where there is no terminal, one line at the end."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[message]}"),
        )
        with Bars(*columns, console=self._errors, transient=False) as bars:
            task = bars.add_task(f"{name:<16}", total=None, message="")
            yield lambda done, total, message: bars.update(task, completed=done, total=total, message=message)
