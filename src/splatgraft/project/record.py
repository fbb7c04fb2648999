"""Records of results: the job of a step, the record of its run in step.json, and why a result is stale."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.note import Note

STEP_FILE = "step.json"
Entry = tuple[str, int, int, str]
"""Name, size in bytes, modification time in ns and SHA-256 of one input file.

The hash of a file above `_MAX_HASHED_BYTES` is that of its size and modification time.
"""
_MAX_HASHED_BYTES = 4 << 30  # hashing more takes over 10 s; only networks' weights and long videos are larger

_LONGEST_REASON = 100  # characters; longer reasons omit the values


@dataclass(frozen=True)
class Job:
    """A wanted result: a step, its folder, its inputs and its options."""

    step: str
    """The command."""
    folder: Path
    """Folder of the result."""
    inputs: Mapping[str, tuple[Path, ...]]
    """Files whose content the result depends on, by role."""
    options: Mapping[str, Any]
    """Plain JSON values that the result depends on."""
    remedy: str = ""
    """Advice for warnings that have none of their own."""

    @cached_property
    def entries(self) -> Mapping[str, tuple[Entry, ...]]:
        """Entries of the input files by role, as of the first access; raises ValueError if a file is missing."""
        return {role: input_entries(files, ()) for role, files in self.inputs.items()}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the step's name, its options and the content of its inputs."""
        content = {role: [(e[0], e[3]) for e in entries] for role, entries in self.entries.items()}
        text = json.dumps([self.step, content, self.options], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def input_entries(files: Iterable[Path], known: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Return one entry per file; a hash is reused from `known` if name, size and modification time are equal."""
    hashes = {entry[:3]: entry[3] for entry in known}
    entries: list[Entry] = []
    for path in files:
        try:
            status = path.stat()
            key = (path.name, status.st_size, status.st_mtime_ns)
            if key not in hashes and status.st_size > _MAX_HASHED_BYTES:
                hashes[key] = hashlib.sha256(repr(key[1:]).encode()).hexdigest()
            elif key not in hashes:
                with path.open("rb") as stream:
                    hashes[key] = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise ValueError(f"{path}: expected an input file, found {error.strerror}") from error
        entries.append((*key, hashes[key]))
    return tuple(entries)


@dataclass(frozen=True)
class Record:
    """The content of step.json: inputs, options and cost of the run that made a folder."""

    step: str
    """The command."""
    version: str
    """Version of splatgraft."""
    options: Mapping[str, Any]
    """All options, resolved, as plain JSON."""
    inputs: Mapping[str, tuple[Entry, ...]]
    """Files read, by role."""
    outputs: tuple[str, ...]
    """Files written, relative to the folder."""
    seconds: float
    """Wall time of the run that finished; earlier, killed runs do not count."""
    peak_memory_bytes: int
    """Largest resident memory while it ran; 0 if unknown."""
    warnings: tuple[Note, ...] = ()
    """Warnings in the order in which they were printed; pictures are relative to the folder."""

    @property
    def memory(self) -> str:
        """The largest resident memory in GiB, as text; empty if unknown."""
        return f"{self.peak_memory_bytes / 2**30:.2f} GiB" if self.peak_memory_bytes else ""


def read_record(folder: Path) -> Record | None:
    """Read the record of a finished result, None if missing; raises ValueError if step.json is damaged."""
    path = folder / STEP_FILE
    if not path.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        inputs = {role: tuple(tuple(e) for e in files) for role, files in found.pop("inputs").items()}
        warnings = tuple(_note(**warning) for warning in found.pop("warnings", ()))
        return Record(inputs=inputs, outputs=tuple(found.pop("outputs")), warnings=warnings, **found)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected the record of a step, found {type(error).__name__}: {error}") from error


def why_stale(job: Job) -> str | None:
    """Describe in a few words why the folder is not the result of `job`; None if it is."""
    record = read_record(job.folder)
    if record is None:
        return "not made yet"
    if missing := [name for name in record.outputs if not (job.folder / name).is_file()]:
        return f"{missing[0]} was removed"
    options = json.loads(json.dumps(job.options))
    for key in sorted(options):
        if options.get(key) != record.options.get(key):
            text = f"{key} is now {options.get(key)}, was {record.options.get(key)}"
            return text if len(text) < _LONGEST_REASON else f"{key} changed"
    for role in sorted({*job.inputs, *record.inputs}):
        before = record.inputs.get(role, ())
        now = input_entries(job.inputs.get(role, ()), before)
        if [e[0] for e in now] != [e[0] for e in before]:
            return f"{role}: {len(now)} files, was {len(before)}" if len(now) != len(before) else f"{role}: other files"
        if changed := [a[0] for a, b in zip(now, before, strict=True) if a[3] != b[3]]:
            return f"{role}: {changed[0]} changed" + (f" and {len(changed) - 1} more" if len(changed) > 1 else "")
    return None


def write_record(folder: Path, record: Record) -> None:
    """Write step.json into `folder`, one field per line."""
    content = {**vars(record), "warnings": [_plain(note) for note in record.warnings]}
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    with atomic_write(folder / STEP_FILE) as stream:
        stream.write(f"{{\n{lines}\n}}\n".encode())


def _plain(note: Note) -> dict[str, Any]:
    """Return a warning as plain JSON, with its remedy if it has one."""
    picture = None if note.picture is None else note.picture.as_posix()
    remedy = {"remedy": note.remedy} if note.remedy else {}
    return {"text": note.text, "picture": picture, "minor": note.level == "minor", **remedy}


def _note(text: str, picture: str | None = None, minor: bool = False, remedy: str = "") -> Note:
    return Note(text, "minor" if minor else "warning", remedy, None if picture is None else Path(picture))
