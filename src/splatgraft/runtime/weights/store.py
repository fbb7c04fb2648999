"""Where weights are kept: ~/.cache/splatgraft/weights/OWNER--NAME, plain files as in the repository, and a record.

A folder can be copied to a machine without a network. weights.json in it has the repository, its commit, and the size
and SHA-256 of every file.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.progress import Progress, silent
from splatgraft.runtime.weights.catalogue import ModelWeights
from splatgraft.runtime.weights.layout import HubFile, needed_files

RECORD_FILE = "weights.json"


def home() -> Path:
    """The folder of all weights that were fetched."""
    return Path.home() / ".cache" / "splatgraft" / "weights"


def folder_of(repository: str) -> Path:
    """The folder of a repository's files, or of a model that is on no hub by its name."""
    return home() / repository.replace("/", "--")


@dataclass(frozen=True)
class StoredWeights:
    """What is recorded of a folder of weights."""

    repository: str
    commit: str
    """Of the repository; empty where the files are on no hub."""
    licence: str
    files: tuple[HubFile, ...]

    def missing(self, folder: Path, wanted: Sequence[HubFile] | None = None) -> list[HubFile]:
        """The files (`wanted` ones, where given) that are not in `folder` with their size."""
        return [file for file in (self.files if wanted is None else wanted) if not is_whole(folder, file)]


def is_stored(folder: Path, model: ModelWeights) -> bool:
    """Whether a folder's record has all that a model needs, and the files are there with their sizes.

    Raises:
        ValueError: The record is damaged.
    """
    stored = read_stored(folder)
    if stored is None:
        return False
    try:
        wanted = stored.files if model.urls else needed_files(stored.files, model)
    except ValueError:
        return False
    return not stored.missing(folder, wanted)


def is_whole(folder: Path, file: HubFile) -> bool:
    """Whether the file is there with its size."""
    path = folder / file.path
    return path.is_file() and path.stat().st_size == file.size


def read_stored(folder: Path) -> StoredWeights | None:
    """The record of a folder; None where there is none.

    Raises:
        ValueError: The record is damaged.
    """
    path = folder / RECORD_FILE
    if not path.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        files = tuple(HubFile(**entry) for entry in found["files"])
        return StoredWeights(found["repository"], found["commit"], found["licence"], files)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected the record of fetched weights, found {type(error).__name__}") from error


def write_stored(folder: Path, stored: StoredWeights) -> None:
    """Write the record; files of an earlier one of the same commit stay in it."""
    before = read_stored(folder)
    files = {file.path: file for file in (before.files if before and before.commit == stored.commit else ())}
    files |= {file.path: file for file in stored.files}
    in_order = tuple(files[path] for path in sorted(files))
    merged = StoredWeights(stored.repository, stored.commit, stored.licence, in_order)
    with atomic_write(folder / RECORD_FILE) as stream:
        stream.write((json.dumps(asdict(merged), indent=1) + "\n").encode())


def check_files(folder: Path, files: Sequence[HubFile], *, progress: Progress = silent) -> list[str]:
    """Compare sizes and hashes with the record.

    Args:
        folder: Where the files are.
        files: What they should be; a file without a hash is compared by size alone.
        progress: Called with bytes done and in all.

    Returns:
        One line for each file that is not as recorded.
    """
    faults, done, total = [], 0, sum(file.size for file in files)
    for file in files:
        path = folder / file.path
        if not path.is_file():
            faults.append(f"{path}: expected {file.size} bytes, found no file")
        elif path.stat().st_size != file.size:
            faults.append(f"{path}: expected {file.size} bytes, found {path.stat().st_size}; is the download complete?")
        elif file.sha256 is not None and (found := sha256_of(path)) != file.sha256:
            faults.append(f"{path}: expected the SHA-256 {file.sha256[:12]}..., found {found[:12]}...")
        done += file.size
        progress(done, total, file.path)
    return faults


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
