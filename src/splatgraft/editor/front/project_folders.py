"""The projects that one server shows: which there are, and the part of the address that names each."""

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatgraft.project.layout import PROJECT_FILE

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_DIGITS = 8
"""Hexadecimal digits of the hash in an address."""


@dataclass(frozen=True)
class ProjectFolder:
    """One project of the list."""

    key: str
    """Its part of the address: letters, digits, dots, dashes and underscores, which need no quoting."""
    name: str
    """Its name for the user: that of its folder."""
    file: Path
    """project.toml; absolute."""


def find_projects(paths: Sequence[Path]) -> tuple[ProjectFolder, ...]:
    """The projects at the given paths.

    Args:
        paths: Project files, their folders, or folders that hold such folders.

    Returns:
        In the order given, those of one folder by name.

    Raises:
        ValueError: If there is no project at one of the paths.
    """
    files: dict[Path, None] = {}
    for path in paths:
        found = (path,) if path.suffix == ".toml" else projects_inside(path)
        if path.suffix != ".toml" and (path / PROJECT_FILE).is_file():
            found = (path / PROJECT_FILE,)
        if not found or not found[0].exists():
            what = "neither" if path.exists() else "nothing there"
            raise ValueError(f"{path}: expected a project or a folder that holds projects, found {what}")
        files |= dict.fromkeys(file.absolute() for file in found)
    projects = [project_folder(file) for file in files]
    counts = Counter(project.key for project in projects)
    return tuple(
        replace(project, key=f"{project.key}-{_hash(str(project.file))}") if counts[project.key] > 1 else project
        for project in projects
    )


def projects_inside(folder: Path) -> tuple[Path, ...]:
    """The project files in the folders of a folder, by name."""
    if not folder.is_dir():
        return ()
    files = (inner / PROJECT_FILE for inner in sorted(folder.iterdir(), key=_by_name) if not inner.name.startswith("."))
    return tuple(file for file in files if file.is_file())


def project_folder(file: Path) -> ProjectFolder:
    """A project by its file, which need not exist."""
    name = file.absolute().parent.name or "project"
    if _PLAIN_NAME.fullmatch(name):
        return ProjectFolder(name, name, file.absolute())
    bare = "".join(letter for letter in unicodedata.normalize("NFKD", name) if not unicodedata.combining(letter))
    letters = re.sub(r"[^A-Za-z0-9]+", "-", bare).strip("-")[:40] or "project"
    return ProjectFolder(f"{letters}-{_hash(name)}", name, file.absolute())


def _by_name(path: Path) -> tuple[str, str]:
    return path.name.casefold(), path.name


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:_DIGITS]
