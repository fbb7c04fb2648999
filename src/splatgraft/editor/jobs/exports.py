"""What of a project can be shared: kinds of files, their names and parts, and the files that were written."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from splatgraft.editor.session.project_access import ExportPage, ProjectFiles
from splatgraft.exports.export import Layer
from splatgraft.project.layout import EXPORTS_FOLDER, REPORT_FILE
from splatgraft.runtime.optional_dependencies import extra_providing

_EXPORTS_PREFIX = f"{EXPORTS_FOLDER}/"
_REPORT_NAME = "report"


@dataclass(frozen=True)
class ShareKind:
    """One kind of file."""

    suffix: str
    """Of the file, with the dot; it names the format."""
    page: ExportPage = "viewer"
    """What an .html holds."""
    module: str | None = None
    """An optional module that the format needs."""

    @property
    def has_parts(self) -> bool:
        """Whether a part of the scene can be written alone."""
        return self.page == "viewer"


SHARE_KINDS: dict[str, ShareKind] = {
    "Page to look at (.html)": ShareKind(".html"),
    "Report as one page (.html)": ShareKind(".html", page="report"),
    "Picture (.png)": ShareKind(".png"),
    "Picture (.jpg)": ShareKind(".jpg"),
    "Turntable, video (.mp4)": ShareKind(".mp4"),
    "Turntable, animation (.webp)": ShareKind(".webp"),
    "Turntable, animation (.gif)": ShareKind(".gif"),
    "Scene, small (.sog)": ShareKind(".sog"),
    "Scene, small (.spz)": ShareKind(".spz", module="zstandard"),
    "Scene, SuperSplat (.compressed.ply)": ShareKind(".compressed.ply"),
    "Scene, exact (.ply)": ShareKind(".ply"),
    "Scene, old viewers (.splat)": ShareKind(".splat"),
    "Scene, glTF (.glb)": ShareKind(".glb"),
    "Scene, OpenUSD (.usdz)": ShareKind(".usdz", module="pxr"),
}
"""By the name that a user chooses."""

PARTS: dict[str, Layer] = {
    "all": "all",
    "object alone": "object",
    "scene alone": "scene",
    "object with shadow": "object-with-shadow",
    "shadow alone": "shadow",
}
"""Parts of the scene, by the name that a user chooses."""


def missing_package(kind: ShareKind) -> str | None:
    """What must be installed before this kind can be written; None where nothing is missing."""
    if kind.module is None or find_spec(kind.module) is not None:
        return None
    extra = extra_providing(kind.module)
    return f"{kind.suffix}: needs a package that is not installed: pip install 'splatgraft[{extra}]'"


def export_path(files: ProjectFiles, kind: ShareKind, layer: Layer) -> Path:
    """Where a shared file is written; its name says the project and the part.

    Raises:
        ValueError: If there is no result or no report yet.
    """
    if kind.page == "report":
        if not has_report(files):
            raise ValueError(f"{files.report / REPORT_FILE}: expected a report, found none yet; run it first")
        part = f"_{_REPORT_NAME}"
    elif not has_scene(files):
        raise ValueError(f"{files.result}: expected a finished scene, found none yet; run the transfer first")
    else:
        part = "" if layer == "all" else f"_{layer.replace('-', '_')}"
    name = files.root.resolve().name or "scene"
    return files.root / EXPORTS_FOLDER / f"{name}{part}{kind.suffix}"


def has_scene(files: ProjectFiles) -> bool:
    """Whether there is a scene with transferred light to share."""
    return files.result.is_file() or files.relit.is_file()


def has_report(files: ProjectFiles) -> bool:
    """Whether the report's page was written."""
    return (files.report / REPORT_FILE).is_file()


def step_shown(files: ProjectFiles, *, is_report: bool) -> str:
    """The step whose result a shared file shows."""
    if is_report:
        return "evaluate"
    return "consolidate" if files.result.is_file() else "relight"


def picture_path(files: ProjectFiles, name: str) -> Path:
    """Path of an exported image."""
    return files.root / EXPORTS_FOLDER / f"{name}.png"


def written_exports(files: ProjectFiles) -> tuple[Path, ...]:
    """The shared files, the newest first."""
    folder = files.root / EXPORTS_FOLDER
    if not folder.is_dir():
        return ()
    found = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return tuple(sorted(found, key=lambda path: (-path.stat().st_mtime_ns, path.name)))


def served_file(files: ProjectFiles, name: str) -> Path | None:
    """The file of the report, or the shared file, that the page's server gives for a name; None for any other name."""
    is_export = name.startswith(_EXPORTS_PREFIX)
    folder = (files.root / EXPORTS_FOLDER if is_export else files.report).resolve()
    path = (folder / name.removeprefix(_EXPORTS_PREFIX if is_export else "")).resolve()
    return path if path.is_relative_to(folder) and path.is_file() and not path.name.startswith(".") else None
