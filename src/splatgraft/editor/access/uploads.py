"""Uploaded files: written to the project's disk part by part, checked as a file on disk, then stored."""

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from splatgraft.capture import read_video_facts
from splatgraft.formats import SCENE_SUFFIXES, read_gaussians

UPLOADS_FOLDER = "uploads"
SCENES = SCENE_SUFFIXES
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
SUFFIXES = (*SCENES, *VIDEOS)
LIMIT_BYTES = 8 << 30
"""Largest accepted upload."""
_SPARE_BYTES = 1 << 28
"""Room that an upload leaves on the disk."""


@dataclass(frozen=True)
class UploadRules:
    """Which uploads are accepted, and where they are stored."""

    folder: Path
    """The project's folder; files go to uploads/ in it."""
    suffixes: tuple[str, ...]
    """Accepted suffixes, lower case."""
    limit: int = LIMIT_BYTES
    """Largest size, bytes."""

    def path(self, name: str) -> Path:
        """The path of an upload under a browser's name for it.

        Raises:
            ValueError: If the suffix is not accepted.
        """
        plain = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(name.replace("\\", "/")).name).lstrip(".") or "upload"
        path = self.folder / UPLOADS_FOLDER / plain
        if path.suffix.lower() not in self.suffixes:
            raise ValueError(f"{plain}: expected a file that ends in {', '.join(self.suffixes)}, found '{path.suffix}'")
        return path


class IncomingUpload:
    """One upload that is being received; holds one part at a time in memory."""

    def __init__(self, rules: UploadRules, name: str, size: int) -> None:
        """Open the file that receives the parts.

        Args:
            rules: Which uploads are accepted.
            name: The browser's name of the file.
            size: Its size, bytes.

        Raises:
            ValueError: If its suffix or its size is not accepted, or the disk has too little room.
        """
        self.path = rules.path(name)
        if not 0 < size <= rules.limit:
            found = "an empty one" if size <= 0 else f"{size >> 20} MiB"
            raise ValueError(
                f"{self.path.name}: expected a file of at most {rules.limit >> 20} MiB, found {found}; "
                "give its path instead"
            )
        self.path.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self.path.parent).free
        if size + _SPARE_BYTES > free:
            raise ValueError(
                f"{self.path.name}: expected room for {size >> 20} MiB, found {free >> 20} MiB on the disk"
            )
        self.size, self.received = size, 0
        self._parts = 0
        self._trial = self.path.with_name(f".trial_{self.path.stem}{self.path.suffix.lower()}")
        self._stream: BinaryIO = self._trial.open("wb")

    @property
    def is_complete(self) -> bool:
        """Whether all bytes have arrived."""
        return self.received == self.size

    def add(self, index: int, content: bytes) -> None:
        """Write the next part.

        Raises:
            ValueError: If it is not the next one, or there are more bytes than were announced.
        """
        if index != self._parts or self.received + len(content) > self.size:
            raise ValueError(f"{self.path.name}: expected {self.size} bytes in order, found others; upload it again")
        self._stream.write(content)
        self._parts, self.received = self._parts + 1, self.received + len(content)

    def finish(self) -> Path:
        """Check the file as one on disk and store it; it replaces an earlier one of that name.

        Raises:
            ValueError: If it is incomplete, or cannot be read as what its suffix says.
        """
        self._stream.close()
        try:
            if not self.is_complete:
                raise ValueError(
                    f"{self.path.name}: expected {self.size} bytes, found {self.received}; upload it again"
                )
            check_file(self._trial)
            self._trial.replace(self.path)
        except ValueError as error:
            raise ValueError(str(error).replace(str(self._trial), self.path.name)) from None
        finally:
            self.discard()
        return self.path

    def discard(self) -> None:
        """Delete what has arrived, unless it is stored already."""
        self._stream.close()
        self._trial.unlink(missing_ok=True)


def check_file(path: Path) -> None:
    """Read a scene, or the first frame of a video.

    Raises:
        ValueError: If it cannot be read.
    """
    if path.suffix.lower() in SCENES:
        read_gaussians(path)
    else:
        read_video_facts(path)


def remove_remains(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> None:
    """Delete parts of uploads that a killed editor left in a project's folder."""
    for path in (folder / UPLOADS_FOLDER).glob(".trial_*"):
        if path.suffix in suffixes:
            path.unlink()
