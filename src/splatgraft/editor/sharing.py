"""Files that a project can share, with their kinds, names and parts, and those already written."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from splatgraft.editor.project import ExportPage, ProjectFiles
from splatgraft.exports.export import Layer
from splatgraft.project.layout import EXPORTS_FOLDER, REPORT_FILE
from splatgraft.runtime.optional_dependencies import extra_providing


@dataclass(frozen=True)
class ShareKind:
    """One kind of file."""

    suffix: str
    """Suffix of the file, with the dot; it names the format."""
    page: ExportPage = "viewer"
    """Contents of an .html; the report has no parts."""
    module: str | None = None
    """An optional module that the format needs."""


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
}
"""Kinds of files, by the label in the menu."""

PARTS: dict[str, Layer] = {
    "all": "all",
    "object alone": "object",
    "scene alone": "scene",
    "object with shadow": "object-with-shadow",
    "shadow alone": "shadow",
}
"""Parts of the scene, by the label in the menu."""


def why_not(files: ProjectFiles, kind: ShareKind) -> str | None:
    """Return why this kind cannot be written yet, with the remedy; None if it can."""
    if kind.module is not None and find_spec(kind.module) is None:
        extra = extra_providing(kind.module)
        return f"{kind.suffix}: needs a package that is not installed: pip install 'splatgraft[{extra}]'"
    if kind.page == "report":
        return None if has_report(files) else "There is no report yet: make it first."
    has_scene = files.result.is_file() or files.relit.is_file()
    return None if has_scene else "There is no result yet: run the transfer first."


def export_path(files: ProjectFiles, kind: ShareKind, layer: Layer) -> Path:
    """Return the path of a shared file, named by the project and the part."""
    part = "_report" if kind.page == "report" else "" if layer == "all" else f"_{layer.replace('-', '_')}"
    return files.root / EXPORTS_FOLDER / f"{files.root.resolve().name or 'scene'}{part}{kind.suffix}"


def has_report(files: ProjectFiles) -> bool:
    """Return whether the report's page was written."""
    return (files.report / REPORT_FILE).is_file()


def step_shown(files: ProjectFiles, *, is_report: bool) -> str:
    """Return the step whose result a shared file shows."""
    if is_report:
        return "evaluate"
    return "consolidate" if files.result.is_file() else "relight"


def written_exports(files: ProjectFiles) -> tuple[Path, ...]:
    """List the shared files, newest first."""
    found = [path for path in (files.root / EXPORTS_FOLDER).glob("[!.]*") if path.is_file()]
    return tuple(sorted(found, key=lambda path: (-path.stat().st_mtime_ns, path.name)))


def served_file(files: ProjectFiles, name: str) -> Path | None:
    """Return the report's file or the shared file to serve for a name; None for any other name."""
    is_export = name.startswith(f"{EXPORTS_FOLDER}/")
    folder = (files.root / EXPORTS_FOLDER if is_export else files.report).resolve()
    path = (folder / name.removeprefix(f"{EXPORTS_FOLDER}/" if is_export else "")).resolve()
    return path if path.is_relative_to(folder) and path.is_file() and not path.name.startswith(".") else None
