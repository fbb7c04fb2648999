"""A wanted result: the step, its folder, its input files with their hashes, and its options."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

Entry = tuple[str, int, int, str]
"""Name, size in bytes, modification time in ns, sha256 of one input file."""


@dataclass(frozen=True)
class Job:
    """A wanted result: a step, its folder, its inputs and its options."""

    step: str
    """The command."""
    folder: Path
    """Where the result goes."""
    inputs: Mapping[str, tuple[Path, ...]]
    """Files whose content the result depends on, by role."""
    options: Mapping[str, Any]
    """Plain JSON values that the result depends on."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Of the options that have one: what an earlier version did, which did not have the option yet."""

    @cached_property
    def entries(self) -> Mapping[str, tuple[Entry, ...]]:
        """The input files at the first access, by role.

        Raises:
            ValueError: An input file is missing.
        """
        return {role: input_entries(files, ()) for role, files in self.inputs.items()}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the step's name, its options and the content of its inputs.

        Raises:
            ValueError: An input file is missing.
        """
        content = {role: [(e[0], e[3]) for e in entries] for role, entries in self.entries.items()}
        text = json.dumps([self.step, content, self.options], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def input_entries(files: Iterable[Path], known: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """One entry per file; the hash is taken from `known` where name, size and modification time are the same."""
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
