"""The interface of a step, and its execution: locked, timed, resumable, with the result folder replaced as a whole."""

import os
import shutil
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, get_args, runtime_checkable

import filelock
import tyro

from splatgraft.project.record import STEP_FILE, Job, Record, read_record, write_record
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_folder, atomic_write, room_on_disk, writable
from splatgraft.runtime.note import Note
from splatgraft.runtime.process import peak_memory_bytes, reset_peak_memory
from splatgraft.runtime.progress import Progress
from splatgraft.runtime.settings import default_of

if TYPE_CHECKING:
    import torch  # takes seconds, which the editor's page does not wait for

Positional = Annotated[Path, tyro.conf.Positional]
Device = Literal["auto", "cpu", "cuda"]
Inputs = Mapping[str, tuple[Path, ...]]
_MACHINE = ("device", "batch", "compile", "processes", "ray", "max_cost", "accept_doubtful")
"""Options that change where and how fast a step runs, or whether a run goes on after it, not its result."""
_CONTINUES = "; earlier results are complete, and the same command continues when there is room"
DEFAULT_REMEDIES = {
    "capture": "add or replace the photos named, or take more, sharper and with more overlap: splatgraft check PHOTOS",
    "reconstruct": "leave the named photos out, or lock exposure and photograph again: splatgraft check PHOTOS",
    "segment": "put the box around the object, or paint what is missing: splatgraft edit PROJECT, step Select",
    "compose": "drag the object to where it should stand and press Drop: splatgraft edit PROJECT, step Place",
    "relight": "turn the arrow of the light to where it comes from: splatgraft edit PROJECT, step Light",
}
"""What helps most where a step is unsure and its note says nothing better; PROJECT stands for the project's folder."""


class FolderCheckpoint:
    """A `Checkpoint` with a folder for files; killed runs of one job share it, another job starts with an empty one."""

    def __init__(self, job: Job) -> None:
        """Open the checkpoint of an earlier run of the same job, or start an empty one."""
        self.folder = job.folder.with_name(f".{job.folder.name}.checkpoint")
        key, name = self.folder / "job", job.fingerprint
        if not key.is_file() or key.read_text() != name:
            self.drop()
            self.folder.mkdir(parents=True)
            with atomic_write(key) as stream:
                stream.write(name.encode())

    def load(self) -> dict[str, Any] | None:
        """The last state saved for this job, or None."""
        import torch

        path = self.folder / "state.pt"
        return torch.load(path, weights_only=True) if path.is_file() else None

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state atomically."""
        import torch

        with atomic_write(self.folder / "state.pt") as stream:
            torch.save(state, stream)

    def drop(self) -> None:
        """Remove the checkpoint."""
        shutil.rmtree(self.folder, ignore_errors=True)


@dataclass(frozen=True)
class Context:
    """Arguments of a step besides its own fields."""

    progress: Progress
    """Moves the progress bar."""
    checkpoint: FolderCheckpoint
    """State that a killed run leaves to the next."""
    console: Console
    """For messages."""


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
    """The job of `step`: what its result depends on; a step with `recorded_options` names its options itself."""
    recorded = getattr(step, "recorded_options", None)
    options: dict[str, Any] = plain_options(vars(step)) if recorded is None else recorded()
    defaults = {one.name: default_of(one) for one in fields(type(step))}  # pyright: ignore[reportArgumentType]
    return Job(
        step=type(step).__name__.lower(),
        folder=step.out,
        inputs=step.inputs(),
        options=options,
        defaults=plain_options({name: value for name, value in defaults.items() if value is not MISSING}),
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
    with locked(job.folder), room_on_disk(job.folder, _CONTINUES), console.collecting() as warned:
        checkpoint = FolderCheckpoint(job)
        with console.bar(name or job.step) as progress, replacing(job, warned) as folder:
            step.write(folder, Context(progress=progress, checkpoint=checkpoint, console=console))
        checkpoint.drop()
    return job.folder


def choose_device(wanted: str, console: Console) -> "torch.device":
    """The device to work on, said aloud.

    Raises: ValueError where CUDA is asked for and there is none, or another device is.
    """
    import torch

    if wanted not in get_args(Device):
        raise ValueError(f"--device: expected {', '.join(get_args(Device))}, found {wanted}")
    has_cuda = torch.cuda.is_available()
    if wanted == "cuda" and not has_cuda:
        raise ValueError("--device: expected a CUDA device that torch can use, found none; splatgraft doctor says more")
    device = "cuda" if wanted != "cpu" and has_cuda else "cpu"
    reason = "no CUDA device found" if wanted == "auto" and not has_cuda else f"--device {wanted}"
    console.say_once(f"device: {device} ({reason})")
    return torch.device(device)


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


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Lock `folder` for this process; a ValueError where another process holds the lock, or it cannot be written."""
    file = folder.with_name(f".{folder.name}.lock")
    lock = filelock.FileLock(file)
    try:
        with writable(file):
            folder.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
    except filelock.Timeout as error:
        where = folder if folder.exists() else folder.parent
        raise ValueError(f"{where}: expected no other run at work here, found one; wait for it or end it") from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def replacing(job: Job, warned: Sequence[Note] = ()) -> Generator[Path]:
    """Give a new folder to write the result into; at the end it replaces the earlier one and gets its step.json.

    A run that is killed or fails at any point leaves the earlier result complete. `warned` is read at the end. A
    ValueError where the folder holds files that no step wrote, or an input is missing.
    """
    inputs = job.entries
    if job.folder.exists() and not job.folder.is_dir():
        raise ValueError(f"{job.folder}: expected a folder for the result, found a file")
    if job.folder.is_dir() and any(job.folder.iterdir()) and read_record(job.folder) is None:
        raise ValueError(f"{job.folder}: expected no folder or one that a step wrote, found files without {STEP_FILE}")
    reset_peak_memory()
    start = time.monotonic()
    with atomic_folder(job.folder) as folder:
        yield folder
        outputs = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
        record = Record(
            step=job.step,
            version=version("splatgraft"),
            options=job.options,
            inputs=inputs,
            outputs=tuple(outputs),
            seconds=round(time.monotonic() - start, 3),
            peak_memory_bytes=peak_memory_bytes(),
            warnings=tuple(_recorded(note, job, folder) for note in warned),
        )
        write_record(folder, record)


def _recorded(note: Note, job: Job, new: Path) -> Note:
    """The note with a remedy, and its picture relative to the result's final folder."""
    remedy = note.remedy or DEFAULT_REMEDIES.get(job.step, "")
    if note.picture is None:
        return replace(note, remedy=remedy)
    base = new if note.picture.is_relative_to(new) else job.folder
    return replace(note, remedy=remedy, picture=Path(os.path.relpath(note.picture, base)))


def clear_leftovers(folder: Path) -> None:
    """Remove the temporary folders that killed runs left beside a result that is up to date."""
    with locked(folder):
        for kind in ("new", "old", "checkpoint"):
            shutil.rmtree(folder.with_name(f".{folder.name}.{kind}"), ignore_errors=True)
