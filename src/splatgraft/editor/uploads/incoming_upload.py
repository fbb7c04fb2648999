"""Uploads on the project's disk: what has arrived of each file lies in uploads/ until all of it is there and checked.

What has arrived of a file is named by a digest of the file's name, size, time of modification and of its first and last
bytes, so that an upload of the same file continues it, and one of a changed file does not. Nothing here imports torch.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

UPLOADS_FOLDER = "uploads"
LIMIT_BYTES = 8 << 30
"""Largest accepted upload."""
SAMPLE_BYTES = 64 << 10
"""How much of a file's beginning and of its end tells it from a changed one."""
KEPT_DAYS = 7
"""How long what has arrived of an interrupted upload is kept."""
_SPARE_BYTES = 1 << 28
"""Room that an upload leaves on the disk."""
_NAME_LETTERS = 150
"""Most letters of a stored file's name before its suffix."""
_PART = re.compile(r"\.incoming_([0-9a-f]{16})_([0-9]+)_(.+)")
"""Name of what has arrived: digest, size of the whole file, its name."""


@dataclass(frozen=True)
class AnnouncedFile:
    """A file on the user's machine, as the browser describes it."""

    name: str
    """Its name."""
    size: int
    """Its size, bytes."""
    modified: int
    """When it was last modified, milliseconds since 1970."""

    def digest(self, sample: bytes) -> str:
        """What tells this file from others and from its own changed versions.

        Args:
            sample: The first and the last `SAMPLE_BYTES`, joined; of a small file they overlap.
        """
        facts = json.dumps([self.name, self.size, self.modified]).encode()
        return hashlib.sha256(facts + sample).hexdigest()[:16]


@dataclass(frozen=True)
class UploadRules:
    """Which uploads are accepted, and where they are stored."""

    folder: Path
    """The project's folder; files go to uploads/ in it."""
    suffixes: tuple[str, ...]
    """Accepted suffixes, lower case."""
    check: Callable[[Path], None]
    """Reads a file that has arrived; raises ValueError where it is not what its suffix says."""
    limit: int = LIMIT_BYTES
    """Largest size, bytes."""

    def accepted_path(self, file: AnnouncedFile) -> Path:
        """The path under which a file would be stored.

        Raises:
            ValueError: If its suffix or its size is not accepted.
        """
        plain = Path(re.sub(r"[^A-Za-z0-9._-]+", "_", Path(file.name.replace("\\", "/")).name).lstrip(".") or "upload")
        path = self.folder / UPLOADS_FOLDER / f"{plain.stem[:_NAME_LETTERS]}{plain.suffix}"
        if path.suffix.lower() not in self.suffixes:
            raise ValueError(
                f"{path.name}: expected a file that ends in {', '.join(self.suffixes)}, found '{path.suffix}'"
            )
        if not 0 < file.size <= self.limit:
            found = "an empty one" if file.size <= 0 else f"{file.size >> 20} MiB"
            raise ValueError(
                f"{path.name}: expected a file of at most {self.limit >> 20} MiB, found {found}; give its path instead"
            )
        return path


class IncomingUpload:
    """One upload that is being received; holds one part at a time in memory."""

    def __init__(self, rules: UploadRules, file: AnnouncedFile, digest: str) -> None:
        """Open the file that receives the parts: that of an interrupted upload of the same file, or a new one.

        What has arrived of other files of that name is deleted.

        Args:
            rules: Which uploads are accepted.
            file: What is announced.
            digest: The file's digest.

        Raises:
            ValueError: If its suffix or its size is not accepted, or the disk has too little room.
        """
        self.path, self.size, self._check = rules.accepted_path(file), file.size, rules.check
        folder = self.path.parent
        folder.mkdir(parents=True, exist_ok=True)
        name = f"{self.path.stem}{self.path.suffix.lower()}"
        self._arriving = folder / f".incoming_{digest}_{file.size}_{name}"
        for path, found in _parts_in(folder):
            if found[3] == name and path != self._arriving:
                path.unlink(missing_ok=True)
        if self._arriving.is_file() and self._arriving.stat().st_size > file.size:
            self._arriving.unlink()
        self.received = self._arriving.stat().st_size if self._arriving.is_file() else 0
        free = shutil.disk_usage(folder).free
        if file.size - self.received + _SPARE_BYTES > free:
            raise ValueError(
                f"{self.path.name}: expected room for {(file.size - self.received) >> 20} MiB, found {free >> 20} MiB"
                " on the disk"
            )
        # without a buffer: what was acknowledged is in the file also where the editor is killed
        self._stream = self._arriving.open("ab", buffering=0)

    @property
    def is_complete(self) -> bool:
        """Whether all bytes have arrived."""
        return self.received == self.size

    def add(self, content: bytes) -> None:
        """Write the next part.

        Raises:
            ValueError: If there are more bytes than were announced.
        """
        if self.received + len(content) > self.size:
            raise ValueError(f"{self.path.name}: expected {self.size} bytes, found more; upload it again")
        rest = memoryview(content)
        while rest:
            count = self._stream.write(rest)
            self.received, rest = self.received + count, rest[count:]

    def pause(self) -> None:
        """Close the file; what has arrived is kept."""
        self._stream.close()

    def discard(self) -> None:
        """Delete what has arrived, unless it is stored already."""
        self._stream.close()
        self._arriving.unlink(missing_ok=True)

    def finish(self) -> Path:
        """Check the file as one on disk and store it; it replaces an earlier one of that name.

        Raises:
            ValueError: If it cannot be read as what its suffix says; it is deleted then.
        """
        self._stream.close()
        try:
            self._check(self._arriving)
            self._arriving.replace(self.path)
        except ValueError as error:
            raise ValueError(str(error).replace(str(self._arriving), self.path.name)) from None
        finally:
            self.discard()
        return self.path


@dataclass(frozen=True)
class InterruptedUpload:
    """An upload that can be continued."""

    name: str
    """The file's name, as it would be stored."""
    size: int
    """Size of the whole file, bytes."""
    received: int
    """Bytes that have arrived."""


def interrupted_uploads(folder: Path) -> tuple[InterruptedUpload, ...]:
    """The uploads into a project's folder of which not all has been stored, by name."""
    found = []
    for path, (_, _, size, name) in _parts_in(folder / UPLOADS_FOLDER):
        try:
            found.append(InterruptedUpload(name, int(size), path.stat().st_size))
        except FileNotFoundError:
            continue  # stored or deleted just now
    return tuple(sorted(found, key=lambda upload: upload.name))


def remove_old_uploads(folder: Path, *, now: float) -> tuple[str, ...]:
    """Delete what has arrived of uploads that were not continued for `KEPT_DAYS`; gives a sentence for each.

    Args:
        folder: The project's folder.
        now: The time, seconds since 1970.
    """
    said = []
    for path, (_, _, _, name) in _parts_in(folder / UPLOADS_FOLDER):
        if now - path.stat().st_mtime > KEPT_DAYS * 86400:
            path.unlink(missing_ok=True)
            said.append(f"{name}: its upload was not continued for {KEPT_DAYS} days, and what had arrived was deleted")
    return tuple(said)


def _parts_in(folder: Path) -> list[tuple[Path, tuple[str, str, str, str]]]:
    """The files of interrupted uploads, each with its name and the name's three parts."""
    found = []
    for path in sorted(folder.glob(".incoming_*")):
        match = _PART.fullmatch(path.name)
        if match is not None:
            found.append((path, (match[0], match[1], match[2], match[3])))
    return found
