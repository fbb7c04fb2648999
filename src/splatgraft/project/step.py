"""The interface of a step and its execution: locked, timed, resumable, replacing the result folder as a whole."""

import shutil
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, get_args, runtime_checkable

import filelock
import tyro

from splatgraft.project.record import STEP_FILE, Job, Record, read_record, write_record
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_folder, atomic_write, relative_name, room_on_disk, writable
from splatgraft.runtime.note import Note
from splatgraft.runtime.process import peak_memory_bytes, reset_peak_memory
from splatgraft.runtime.progress import Progress

if TYPE_CHECKING:
    import torch  # takes seconds; the editor's page opens before

Positional = Annotated[Path, tyro.conf.Positional]
Device = Literal["auto", "cpu", "cuda"]
Inputs = Mapping[str, tuple[Path, ...]]
_MACHINE = ("device", "batch", "compile", "processes", "ray", "max_cost", "accept_doubtful")
"""Options that change the device, the speed, or whether a run continues after the step, but not the result."""
_CONTINUES = "; earlier results are complete, and the same command continues when there is room"


class FolderCheckpoint:
    """A `Checkpoint` in a folder. Killed runs of the same job share it; another job starts with an empty one."""

    def __init__(self, job: Job) -> None:
        """Open the checkpoint of an earlier run of the same job, or start an empty one."""
        self.folder = job.folder.with_name(f".{job.folder.name}.checkpoint")
        key, name = self.folder / "job", job.fingerprint
        if not key.is_file() or key.read_text(encoding="utf-8") != name:
            self.drop()
            self.folder.mkdir(parents=True)
            with atomic_write(key) as stream:
                stream.write(name.encode())

    def load(self) -> dict[str, Any] | None:
        """Return the last state saved for this job, or None."""
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
    """Function that moves the progress bar."""
    checkpoint: FolderCheckpoint
    """State of a killed run, for the next run."""
    console: Console
    """Output of messages."""


@runtime_checkable
class Step(Protocol):
    """A frozen dataclass: paths of inputs, options, `out`; its fields are the command's arguments."""

    @property
    def out(self) -> Path:
        """The folder of the result."""
        ...

    def inputs(self) -> Inputs:
        """Return the files that the result depends on, by role.

        Raises: ValueError if a file that lists further files is missing or broken.
        """
        ...

    def write(self, folder: Path, context: Context) -> None:
        """Write the result into `folder`."""
        ...


def job_of(step: Step) -> Job:
    """Return the job of `step`; a method `recorded_options` of the step replaces its fields."""
    recorded = getattr(step, "recorded_options", None)
    options: dict[str, Any] = plain_options(vars(step)) if recorded is None else recorded()
    return Job(
        step=type(step).__name__.lower(),
        folder=step.out,
        inputs=step.inputs(),
        options=options,
        remedy=default_remedy(step),
    )


def default_remedy(step: Step) -> str:
    """Return the step's advice for warnings that have none of their own; PROJECT stands for the project's folder."""
    return getattr(step, "remedy", "")


def path_fields(step: Step) -> list[Path]:
    """Return the paths that `step` reads from."""
    values = [getattr(step, field.name) for field in fields(step) if field.name != "out"]  # pyright: ignore
    return [value for value in values if isinstance(value, Path)]


def perform(step: Step, console: Console, *, name: str = "") -> Path:
    """Perform `step`, whether or not its result is stale, and return the result's folder.

    Raises: ValueError if another run works on the same folder, or the inputs are bad.
    """
    job = job_of(step)
    _ = job.entries  # raises if an input is missing, before any file is changed
    with locked(job.folder), room_on_disk(job.folder, _CONTINUES), console.collecting() as warned:
        checkpoint = FolderCheckpoint(job)
        with console.bar(name or job.step) as progress, replacing(job, warned) as folder:
            step.write(folder, Context(progress=progress, checkpoint=checkpoint, console=console))
        checkpoint.drop()
    return job.folder


def choose_device(wanted: str, console: Console) -> "torch.device":
    """Return the device to compute on, and print it once.

    Raises: ValueError if CUDA is wanted and absent, or `wanted` is no `Device`.
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
    """Return settings as plain JSON; the fields of nested dataclasses become keys beside the others.

    Paths are omitted, because the files' content counts instead; so are settings of the machine, which change only
    rounding.
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
    """Lock `folder` for this process; raises ValueError if another process holds the lock, or it cannot be written."""
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
    """Yield a new folder for the result; at the end it gets its step.json and replaces the earlier folder.

    A run that is killed or fails at any point leaves the earlier result complete. `warned` is read at the end.

    Raises: ValueError if the folder holds files that no step wrote, or an input is missing.
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
        outputs = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
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
    """Return the note with a remedy, and with its picture relative to the result's final folder."""
    remedy = note.remedy or job.remedy
    if note.picture is None:
        return replace(note, remedy=remedy)
    base = new if note.picture.is_relative_to(new) else job.folder
    return replace(note, remedy=remedy, picture=Path(relative_name(note.picture, base)))


def clear_leftovers(folder: Path) -> None:
    """Remove the temporary folders of killed runs beside a result that is up to date."""
    with locked(folder):
        for kind in ("new", "old", "checkpoint"):
            shutil.rmtree(folder.with_name(f".{folder.name}.{kind}"), ignore_errors=True)
