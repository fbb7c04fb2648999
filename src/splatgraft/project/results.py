"""Where results lie, how one replaces an earlier one whole, and what makes it stale. Knows no scenes and no steps."""

import hashlib
import json
import shutil
import time
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import filelock

from splatgraft import __version__
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.atomic_folder import atomic_folder
from splatgraft.runtime.peak_memory import peak_memory_bytes, reset_peak_memory

PROJECT_FILE = "project.toml"
STEP_FILE = "step.json"
SCENE_FILE = "scene.ply"
OBJECT_FILE = "object.ply"
SURROUNDINGS_FILE = "surroundings.ply"
LIGHT_FILE = "light.json"
LIGHT_TEXT_FILE = "light.txt"
SELECTION_FILE = "selection.npy"
IS_OBJECT_FILE = "is_object.npy"
CAMERAS_FILE = "transforms.json"
PLACEMENT_FILE = "placement.json"
REPORT_FILE = "index.html"
METRICS_FILE = "metrics.json"

Side = Literal["source", "target"]

RESULTS_IN_ORDER = (
    "source/capture",
    "source/scene",
    "target/capture",
    "target/scene",
    "object",
    "composite",
    "relit",
    "views",
    "harmonized",
    "result",
    "report",
)
"""All folders of a project, relative to its root, in the order in which they are made."""


@dataclass(frozen=True)
class Layout:
    """The folders of one project, in the order of the flow."""

    root: Path
    """Where all results go: the folder of project.toml unless told otherwise."""

    def capture(self, side: Side) -> Path:
        """Posed images: transforms.json, points.ply."""
        return self.root / side / "capture"

    def scene(self, side: Side) -> Path:
        """The reconstruction: scene.ply."""
        return self.root / side / "scene"

    @property
    def object(self) -> Path:
        """The object alone, and which Gaussians of the source it is."""
        return self.root / "object"

    @property
    def composite(self) -> Path:
        """The object in the target, placed; light as it was."""
        return self.root / "composite"

    @property
    def relit(self) -> Path:
        """The composite with a light prior."""
        return self.root / "relit"

    @property
    def views(self) -> Path:
        """The composite from the target's cameras: what a harmoniser is given."""
        return self.root / "views"

    @property
    def harmonized(self) -> Path:
        """One harmonised image per view."""
        return self.root / "harmonized"

    @property
    def result(self) -> Path:
        """The consolidated scene."""
        return self.root / "result"

    @property
    def report(self) -> Path:
        """Figures and pictures: metrics.json, index.html."""
        return self.root / "report"


Entry = tuple[str, int, int, str]
"""Name, size in bytes, modification time in ns, sha256 of one input file."""


@dataclass(frozen=True)
class Record:
    """What step.json holds: of what, how and by whom a folder was made."""

    step: str
    """The command."""
    version: str
    """Of splatgraft."""
    options: Mapping[str, Any]
    """All options, resolved, as plain JSON."""
    inputs: Mapping[str, tuple[Entry, ...]]
    """Files read, by role."""
    outputs: tuple[str, ...]
    """Files written, relative to the folder."""
    seconds: float
    """Wall time of the run that finished; earlier, killed runs do not count."""
    peak_memory_bytes: int
    """Largest resident memory while it ran."""


@dataclass(frozen=True)
class Job:
    """One result that is wanted: a step, its folder, its inputs and its options."""

    step: str
    """The command."""
    folder: Path
    """Where the result goes."""
    inputs: Mapping[str, tuple[Path, ...]]
    """Files whose content the result depends on, by role."""
    options: Mapping[str, Any]
    """Plain JSON values that the result depends on."""

    @cached_property
    def entries(self) -> Mapping[str, tuple[Entry, ...]]:
        """The input files as they are when this is first asked for, by role.

        Raises: ValueError where one is missing.
        """
        return {role: _entries(files, ()) for role, files in self.inputs.items()}

    @property
    def fingerprint(self) -> str:
        """A name for this very job: it changes with every input byte and every option.

        Raises: ValueError where an input file is missing.
        """
        content = {role: [(e[0], e[3]) for e in entries] for role, entries in self.entries.items()}
        text = json.dumps([self.step, content, self.options], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def read_record(folder: Path) -> Record | None:
    """The record of a finished result, or None where there is none.

    Raises: ValueError where step.json is damaged.
    """
    path = folder / STEP_FILE
    if not path.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        inputs = {role: tuple(tuple(e) for e in files) for role, files in found.pop("inputs").items()}
        return Record(inputs=inputs, outputs=tuple(found.pop("outputs")), **found)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected the record of a step, found {type(error).__name__}: {error}") from error


def why_stale(job: Job) -> str | None:
    """Why the folder does not hold what `job` would make, in a few words; None where it does.

    Raises: ValueError where an input file is missing or step.json is damaged.
    """
    record = read_record(job.folder)
    if record is None:
        return "not made yet"
    if missing := [name for name in record.outputs if not (job.folder / name).is_file()]:
        return f"{missing[0]} was removed"
    options = json.loads(json.dumps(job.options))
    for key in sorted({*options, *record.options}):
        if options.get(key) != record.options.get(key):
            return f"{key} is now {options.get(key)}, was {record.options.get(key)}"
    for role in sorted({*job.inputs, *record.inputs}):
        before = record.inputs.get(role, ())
        now = _entries(job.inputs.get(role, ()), before)
        if [e[0] for e in now] != [e[0] for e in before]:
            return f"{role}: {len(now)} files, was {len(before)}" if len(now) != len(before) else f"{role}: other files"
        if changed := [a[0] for a, b in zip(now, before, strict=True) if a[3] != b[3]]:
            return f"{role}: {changed[0]} changed" + (f" and {len(changed) - 1} more" if len(changed) > 1 else "")
    return None


@contextmanager
def replacing(job: Job) -> Generator[Path]:
    """A new folder to write the result into; it takes the place of the earlier one, with its step.json, at the end.

    Killed or failed at any point, the earlier result stays whole.

    Raises: ValueError where the folder holds what no step wrote, or an input is missing.
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
            version=__version__,
            options=job.options,
            inputs=inputs,
            outputs=tuple(outputs),
            seconds=round(time.monotonic() - start, 3),
            peak_memory_bytes=peak_memory_bytes(),
        )
        with atomic_write(folder / STEP_FILE) as stream:
            stream.write(_one_line_each(asdict(record)).encode())


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Hold `folder` for this process; the system lets go of it when the process ends, however it ends.

    Raises: ValueError where another process holds it.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        raise ValueError(f"{folder}: expected no other run at work here, found one; wait for it or end it") from error
    try:
        yield
    finally:
        lock.release()


def clear_leftovers(folder: Path) -> None:
    """Remove what killed runs left beside a result that needs no further one.

    Raises: ValueError where another process is at work on it.
    """
    with locked(folder):
        for kind in ("new", "old", "checkpoint"):
            shutil.rmtree(folder.with_name(f".{folder.name}.{kind}"), ignore_errors=True)


class FolderCheckpoint:
    """A `Checkpoint` and a place for files, both kept between killed runs of one job and dropped for any other."""

    def __init__(self, job: Job) -> None:
        """Open what an earlier run of the same job left, or start empty."""
        self.folder = job.folder.with_name(f".{job.folder.name}.checkpoint")
        key, name = self.folder / "job", job.fingerprint
        if not key.is_file() or key.read_text() != name:
            self.drop()
            self.folder.mkdir(parents=True)
            with atomic_write(key) as stream:
                stream.write(name.encode())

    def load(self) -> dict[str, Any] | None:
        """The last state saved for this very job, or None."""
        import torch

        path = self.folder / "state.pt"
        return torch.load(path, weights_only=True) if path.is_file() else None

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state, whole or not at all."""
        import torch

        with atomic_write(self.folder / "state.pt") as stream:
            torch.save(state, stream)

    def drop(self) -> None:
        """Forget all of it: the job is done, or it is another one now."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _one_line_each(fields: Mapping[str, Any]) -> str:
    """JSON with one field per line."""
    return "{\n" + ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in fields.items()) + "\n}\n"


def _entries(files: Iterable[Path], known: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """One entry per file; the hash is taken from `known` where size and time have not moved."""
    hashes = {entry[:3]: entry[3] for entry in known}
    entries: list[Entry] = []
    for path in files:
        try:
            status = path.stat()
            key = (path.name, status.st_size, status.st_mtime_ns)
            if key not in hashes:
                with path.open("rb") as stream:
                    hashes[key] = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise ValueError(f"{path}: expected an input file, found {error.strerror}") from error
        entries.append((*key, hashes[key]))
    return tuple(entries)
