"""Replacement of a step's result folder as a whole: the earlier result stays until the new one is complete."""

import os
import shutil
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from splatgraft.project.folder_lock import locked
from splatgraft.project.job import Job
from splatgraft.project.record import STEP_FILE, Record, StepWarning, read_record, write_record
from splatgraft.runtime.atomic_folder import atomic_folder
from splatgraft.runtime.console import ConsoleWarning
from splatgraft.runtime.peak_memory import peak_memory_bytes, reset_peak_memory


@contextmanager
def replacing(job: Job, warned: Sequence[ConsoleWarning] = ()) -> Generator[Path]:
    """Give a new folder to write the result into; at the end it replaces the earlier one and gets its step.json.

    A run that is killed or fails at any point leaves the earlier result complete.

    Args:
        job: What is made.
        warned: The warnings for step.json; read at the end.

    Raises:
        ValueError: The folder holds files that no step wrote, or an input is missing.
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
            warnings=tuple(_recorded(warning, folder, job.folder) for warning in warned),
        )
        write_record(folder, record)


def _recorded(warning: ConsoleWarning, new: Path, folder: Path) -> StepWarning:
    """The warning with its picture relative to the result's final folder."""
    picture = warning.picture
    if picture is None:
        return StepWarning(warning.text, minor=warning.minor)
    base = new if picture.is_relative_to(new) else folder
    return StepWarning(warning.text, os.path.relpath(picture, base), warning.minor)


def clear_leftovers(folder: Path) -> None:
    """Remove the temporary folders that killed runs left beside a result that is up to date.

    Raises:
        ValueError: Another process works on the folder.
    """
    with locked(folder):
        for kind in ("new", "old", "checkpoint"):
            shutil.rmtree(folder.with_name(f".{folder.name}.{kind}"), ignore_errors=True)
