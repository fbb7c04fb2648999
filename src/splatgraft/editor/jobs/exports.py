"""Exports of results: the scene in any supported format, images, the orbit video and the report."""

import shutil
from pathlib import Path

from splatgraft.editor.jobs.orbit_video import write_orbit_video
from splatgraft.editor.session.project_access import ProjectFiles
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.project.layout import REPORT_FILE
from splatgraft.runtime.atomic_file import atomic_write

EXPORTS_FOLDER = "export"


def export_scene(files: ProjectFiles, suffix: str) -> Path:
    """Write the result as export/scene.SUFFIX; in the result's own format byte for byte.

    Raises:
        ValueError: If there is no result yet.
    """
    if not files.result.is_file():
        raise ValueError(f"{files.result}: expected a finished scene, found none yet; run the transfer first")
    path = _folder(files) / f"scene{suffix}"
    if suffix == files.result.suffix:
        with files.result.open("rb") as source, atomic_write(path) as stream:
            shutil.copyfileobj(source, stream)
    else:
        write_gaussians(path, read_gaussians(files.result))
    return path


def export_turntable(files: ProjectFiles, suffix: str) -> tuple[Path, str]:
    """Write the report's turntable as export/turntable.SUFFIX.

    Returns:
        The file, and a remark where it is not in the requested format or browsers do not play it; else an empty string.

    Raises:
        ValueError: If there is none yet.
    """
    found = next((p for p in (files.report / "turntable.webp", files.report / "turntable.gif") if p.is_file()), None)
    if found is None:
        raise ValueError(f"{files.report}: expected a turntable, found none yet; run the report first")
    path = _folder(files) / f"turntable{suffix}"
    if suffix != ".mp4":
        return Path(shutil.copy2(found, path.with_suffix(found.suffix))), ""
    try:
        codec = write_orbit_video(path, found)
    except ValueError as error:
        return Path(shutil.copy2(found, _folder(files) / found.name)), f"{error}; exported {found.name} instead"
    return (
        path,
        ""
        if codec == "H.264"
        else f"in {codec}, which video players support but browsers do not; .webp plays in browsers",
    )


def report_page(files: ProjectFiles) -> Path:
    """The report's page.

    Raises:
        ValueError: If there is none yet.
    """
    page = files.report / REPORT_FILE
    if not page.is_file():
        raise ValueError(f"{page}: expected a report, found none yet; run it first")
    return page


def picture_path(files: ProjectFiles, name: str) -> Path:
    """Path of an exported image."""
    return _folder(files) / f"{name}.png"


def _folder(files: ProjectFiles) -> Path:
    folder = files.root / EXPORTS_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    return folder
