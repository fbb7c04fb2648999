"""The last project.toml with which the project opened, and copies of files that could not be read."""

import shutil
from collections.abc import Iterable
from pathlib import Path

from splatgraft.runtime.files import atomic_write

_GOOD_FILE, _BROKEN_FOLDER, _ASIDE_FOLDER = "project.toml", "broken", "aside"


class ProjectBackup:
    """Copies in a folder of the editor."""

    def __init__(self, project: Path, folder: Path) -> None:
        """Name the project file and the folder; nothing is read or written."""
        self._project, self._folder = project, folder

    def keep(self) -> None:
        """Keep the present project.toml as the last good one."""
        good = self._folder / _GOOD_FILE
        content = self._project.read_bytes()
        if not good.is_file() or good.read_bytes() != content:
            self._folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(good) as stream:
                stream.write(content)

    def has_good(self) -> bool:
        """Whether a good project.toml was kept that differs from the present one."""
        good = self._folder / _GOOD_FILE
        return good.is_file() and not (self._project.is_file() and good.read_bytes() == self._project.read_bytes())

    def restore(self) -> None:
        """Put the last good project.toml back; the present one is kept as a copy.

        Raises:
            ValueError: If none was kept.
        """
        good = self._folder / _GOOD_FILE
        if not good.is_file():
            raise ValueError(
                f"{good}: expected a copy of an earlier project.toml, found none; correct the file by hand"
            )
        self.set_aside([self._project])
        with atomic_write(self._project) as stream:
            stream.write(good.read_bytes())

    def set_aside(self, files: Iterable[Path]) -> Path:
        """Copy files into the folder of broken files, in place of earlier copies; returns the folder."""
        folder = self._folder / _BROKEN_FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        for file in files:
            if file.is_file():
                shutil.copy2(file, folder / file.name)
        return folder

    def move_aside(self, files: Iterable[Path]) -> None:
        """Move the files and folders of the edits out of the project, in place of those moved earlier."""
        aside = self._folder / _ASIDE_FOLDER
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        for file in files:
            if file.exists():
                # the folder of the editor is inside that of the project
                place = aside / file.relative_to(self._project.parent)
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(file, place)

    def has_aside(self) -> bool:
        """Whether a project was moved aside."""
        return (self._folder / _ASIDE_FOLDER / self._project.name).is_file()

    def bring_back(self) -> None:
        """Put what was moved aside back.

        Raises:
            ValueError: If there is nothing, or another project has been made meanwhile.
        """
        aside = self._folder / _ASIDE_FOLDER
        if not self.has_aside() or self._project.is_file():
            found = "another project" if self._project.is_file() else "none"
            raise ValueError(f"{self._project}: expected a project that was set aside, found {found}")
        for file in sorted(path for path in aside.rglob("*") if path.is_file()):
            place = self._project.parent / file.relative_to(aside)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(file, place)
        shutil.rmtree(aside)
