"""step.json: what a result was made of, and whether it is still what the step would make."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatgraft.project.job import Entry, Job, input_entries
from splatgraft.runtime.atomic_file import atomic_write

STEP_FILE = "step.json"


@dataclass(frozen=True)
class StepWarning:
    """Something that may be wrong with a result, as the step said it."""

    text: str
    """One or more sentences."""
    picture: str | None = None
    """An image that shows it, relative to the result's folder."""
    minor: bool = False
    """Whether the step did what was needed by itself, so that its result is not in doubt."""


@dataclass(frozen=True)
class Record:
    """The content of step.json: inputs, options and cost of the run that made a folder."""

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
    warnings: tuple[StepWarning, ...] = ()
    """What may be wrong with the result, in the order in which it was said."""


def read_record(folder: Path) -> Record | None:
    """Read the record of a finished result; None where there is none.

    Raises:
        ValueError: step.json is damaged.
    """
    path = folder / STEP_FILE
    if not path.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        inputs = {role: tuple(tuple(e) for e in files) for role, files in found.pop("inputs").items()}
        warnings = tuple(StepWarning(**warning) for warning in found.pop("warnings", ()))
        return Record(inputs=inputs, outputs=tuple(found.pop("outputs")), warnings=warnings, **found)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected the record of a step, found {type(error).__name__}: {error}") from error


def why_stale(job: Job) -> str | None:
    """Say in a few words why the folder's content is not what `job` would make; None where it is.

    Raises:
        ValueError: An input file is missing or step.json is damaged.
    """
    record = read_record(job.folder)
    if record is None:
        return "not made yet"
    if missing := [name for name in record.outputs if not (job.folder / name).is_file()]:
        return f"{missing[0]} was removed"
    options = json.loads(json.dumps(job.options))
    # an option that came with a later version than the record's was at its default
    before = {**json.loads(json.dumps(job.defaults)), **record.options}
    for key in sorted({*options, *record.options}):
        if options.get(key) != before.get(key):
            return f"{key} is now {options.get(key)}, was {before.get(key)}"
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
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in asdict(record).items())
    with atomic_write(folder / STEP_FILE) as stream:
        stream.write(f"{{\n{lines}\n}}\n".encode())
