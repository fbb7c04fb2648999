"""What every step is, and the one way to do it: locked, timed, resumed, replaced whole. Knows no algorithm."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, get_args, runtime_checkable

import torch
import tyro

from splatgraft.project.checkpoint import FolderCheckpoint
from splatgraft.project.folder_lock import locked
from splatgraft.project.job import Job
from splatgraft.project.replacement import replacing
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress

Positional = Annotated[Path, tyro.conf.Positional]
Device = Literal["auto", "cpu", "cuda"]
Inputs = Mapping[str, tuple[Path, ...]]
_MACHINE = ("device", "batch", "compile", "processes", "ray", "max_cost", "accept_doubtful")
"""Options that say where and how fast work is done, or whether to go on after it, not what comes out."""


@dataclass(frozen=True)
class Context:
    """What a step is handed besides its own fields."""

    progress: Progress
    """Moves the bar."""
    checkpoint: FolderCheckpoint
    """Survives a kill."""
    console: Console
    """For sentences."""
    earlier: Path
    """The result's final place: what an earlier run left there is still whole while this one works."""


@runtime_checkable
class Step(Protocol):
    """A frozen dataclass: paths of inputs, options, `out`; its fields are the command's arguments."""

    @property
    def out(self) -> Path:
        """The folder of the result."""
        ...

    def inputs(self) -> Inputs:
        """Files that the result depends on, by role.

        Raises: ValueError where one that must be read to know is missing or broken.
        """
        ...

    def write(self, folder: Path, context: Context) -> None:
        """Make the result in `folder`."""
        ...


def job_of(step: Step) -> Job:
    """What must be known of `step` to tell whether its result still stands."""
    return Job(step=type(step).__name__.lower(), folder=step.out, inputs=step.inputs(), options=_options(step))


def path_fields(step: Step) -> list[Path]:
    """The paths that `step` reads from."""
    values = [getattr(step, field.name) for field in fields(step) if field.name != "out"]  # pyright: ignore
    return [value for value in values if isinstance(value, Path)]


def perform(step: Step, console: Console, *, name: str = "") -> Path:
    """Do `step`, whether or not its result is stale, and give the folder.

    Raises: ValueError where another run works on the same folder, or the inputs are bad.
    """
    job = job_of(step)
    _ = job.entries  # what is missing is said before anything is touched
    with locked(job.folder):
        checkpoint = FolderCheckpoint(job)
        with console.bar(name or job.step) as progress, replacing(job) as folder:
            step.write(folder, Context(progress=progress, checkpoint=checkpoint, console=console, earlier=step.out))
        checkpoint.drop()
    return job.folder


def choose_device(wanted: str, console: Console) -> torch.device:
    """The device to work on, said aloud.

    Raises: ValueError where CUDA is asked for and there is none, or another device is.
    """
    if wanted not in get_args(Device):
        raise ValueError(f"--device: expected {', '.join(get_args(Device))}, found {wanted}")
    has_cuda = torch.cuda.is_available()
    if wanted == "cuda" and not has_cuda:
        raise ValueError("--device: expected a CUDA device that torch can use, found none; splatgraft doctor says more")
    device = "cuda" if wanted != "cpu" and has_cuda else "cpu"
    reason = "no CUDA device found" if wanted == "auto" and not has_cuda else f"--device {wanted}"
    console.say(f"device: {device} ({reason})")
    return torch.device(device)


def _options(value: Any) -> dict[str, Any]:
    """All settings as plain JSON: neither paths, whose content counts, nor the machine, which only changes rounding."""
    options: dict[str, Any] = {}
    for field in fields(value):
        item = getattr(value, field.name)
        if is_dataclass(item):
            options |= _options(item)
        elif field.name not in _MACHINE and not isinstance(item, Path):
            options[field.name] = list(item) if isinstance(item, tuple) else item
    return options
