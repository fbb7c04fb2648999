"""The interface of a step, and its execution: locked, timed, resumable, with the result replaced atomically."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, get_args, runtime_checkable

import torch
import tyro

from splatgraft.project.checkpoint import FolderCheckpoint
from splatgraft.project.folder_lock import locked
from splatgraft.project.job import Job
from splatgraft.project.replacement import replacing
from splatgraft.runtime.console import Console
from splatgraft.runtime.disk_space import room_on_disk
from splatgraft.runtime.help_link import help_link
from splatgraft.runtime.progress import Progress

Positional = Annotated[Path, tyro.conf.Positional]
Device = Literal["auto", "cpu", "cuda"]
Inputs = Mapping[str, tuple[Path, ...]]
_MACHINE = ("device", "batch", "compile", "processes", "ray", "max_cost", "accept_doubtful")
"""Options that change where and how fast a step runs, or whether a run goes on after it, not its result."""


@dataclass(frozen=True)
class Context:
    """Arguments of a step besides its own fields."""

    progress: Progress
    """Moves the progress bar."""
    checkpoint: FolderCheckpoint
    """State that a killed run leaves to the next."""
    console: Console
    """For messages."""
    earlier: Path
    """The result's final folder; the earlier result stays there until this run is complete."""


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


@runtime_checkable
class RecordsOptions(Protocol):
    """A step whose options in step.json are not just its fields."""

    def recorded_options(self) -> dict[str, Any]:
        """The options as plain JSON values."""
        ...


def job_of(step: Step) -> Job:
    """The job of `step`: what its result depends on."""
    options = step.recorded_options() if isinstance(step, RecordsOptions) else plain_options(vars(step))
    return Job(
        step=type(step).__name__.lower(),
        folder=step.out,
        inputs=step.inputs(),
        options=options,
        defaults=plain_options(_defaults(type(step))),
    )


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
    with locked(job.folder), room_on_disk(job.folder), console.collecting(help_link(type(step).__module__)) as warned:
        checkpoint = FolderCheckpoint(job)
        with console.bar(name or job.step) as progress, replacing(job, warned) as folder:
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


def _defaults(kind: type) -> dict[str, Any]:
    """The fields of a step that have a default."""
    found = {one.name: one.default for one in fields(kind) if one.default is not MISSING}
    return found | {one.name: one.default_factory() for one in fields(kind) if one.default_factory is not MISSING}


def plain_options(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as plain JSON, with the fields of nested dataclasses beside the others.

    Left out are paths, whose content counts instead, and the machine's settings, which change only rounding.
    """
    options: dict[str, Any] = {}
    for name, item in values.items():
        if is_dataclass(item):
            options |= plain_options(vars(item))
        elif name not in _MACHINE and not isinstance(item, Path):
            options[name] = list(item) if isinstance(item, tuple) else item
    return options
