"""Files that a project can share, with their kinds, names and parts, and those already written."""

from importlib.util import find_spec
from pathlib import Path

from splatgraft.editor.project import ProjectFiles
from splatgraft.exports.export import Layer
from splatgraft.project.layout import EXPORTS_FOLDER, REPORT_FILE
from splatgraft.runtime.optional_dependencies import extra_providing

REPORT = "Report as one page (.html)"
SHARE_KINDS = {
    "Page to look at (.html)": ".html",
    REPORT: ".html",
    "Picture (.png)": ".png",
    "Picture (.jpg)": ".jpg",
    "Turntable, video (.mp4)": ".mp4",
    "Turntable, animation (.webp)": ".webp",
    "Turntable, animation (.gif)": ".gif",
    "Scene, small (.sog)": ".sog",
    "Scene, small (.spz)": ".spz",
    "Scene, SuperSplat (.compressed.ply)": ".compressed.ply",
    "Scene, exact (.ply)": ".ply",
    "Scene, old viewers (.splat)": ".splat",
    "Scene, glTF (.glb)": ".glb",
}
"""Suffixes of files, which name the format, by the label in the menu; the report has no parts."""
_MODULES = {".spz": "zstandard"}
"""Optional modules that formats need, by suffix."""
PARTS: dict[str, Layer] = {
    "all": "all",
    "object alone": "object",
    "scene alone": "scene",
    "object with shadow": "object-with-shadow",
    "shadow alone": "shadow",
}
"""Parts of the scene, by the label in the menu."""


def why_not(files: ProjectFiles, kind: str) -> str | None:
    """Return why a file of this label cannot be written yet, with the remedy; None if it can."""
    module = _MODULES.get(SHARE_KINDS[kind])
    if module is not None and find_spec(module) is None:
        extra = extra_providing(module)
        return f"{SHARE_KINDS[kind]}: needs a package that is not installed: pip install 'splatgraft[{extra}]'"
    if kind == REPORT:
        return None if has_report(files) else "There is no report yet: make it first."
    has_scene = files.result.is_file() or files.relit.is_file()
    return None if has_scene else "There is no result yet: run the transfer first."


def export_path(files: ProjectFiles, kind: str, layer: Layer) -> Path:
    """Return the path of a shared file, named by the project and the part."""
    part = "_report" if kind == REPORT else "" if layer == "all" else f"_{layer.replace('-', '_')}"
    return files.root / EXPORTS_FOLDER / f"{files.root.resolve().name or 'scene'}{part}{SHARE_KINDS[kind]}"


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
