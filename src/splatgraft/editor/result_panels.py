"""The steps `Run` and `Share`: compute the result of the edits, and export it or a part of it."""

import shlex
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote

import numpy as np
import torch

from splatgraft.core.images import write_image
from splatgraft.editor.form import Form
from splatgraft.editor.jobs import JobState
from splatgraft.editor.panel import Panel
from splatgraft.editor.project import ProjectFiles
from splatgraft.editor.server import FILES_PREFIX
from splatgraft.editor.session import Session
from splatgraft.exports.export import Layer
from splatgraft.harmonization import HARMONIZERS
from splatgraft.project.layout import EXPORTS_FOLDER, REPORT_FILE
from splatgraft.runtime.optional_dependencies import extra_providing

_LABEL = "Update result"
_LISTED = 6  # number of listed shared files, newest first
_SHOWN_SUFFIXES = (".html", ".png", ".jpg", ".webp", ".gif", ".mp4")
_PICTURE, _SAVED_WIDTH = "view.png", 1280

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


class RunPanel(Panel):
    """Controls to compute the result of the edits."""

    _with_report = False

    def enter(self) -> None:
        """Show the result, if it exists."""
        session = self.editor.session
        if session is not None and session.files.result.is_file():
            self.editor.before, self.editor.kind = "pasted", "result"

    def build(self, form: Form) -> None:
        """Say whether the result is up to date, and add the controls."""
        session, sets = self.session, self._sets("_with_report")
        form.note(self._said(session), name="result")
        form.button("run", _LABEL, lambda: self.editor.run(self._last_step(), _LABEL), main=True)
        form.more()
        method, methods = session.state.harmonizer or "none", {name: name for name in HARMONIZERS}
        form.choice("method", "Image model", method, methods, self._set_method)
        form.check("with_report", "With the report", self._with_report, sets, hint="Numbers and pictures")
        form.note(_command_line(session.project.run_words(self._last_step())), name="command", faint=True)

    def _set_method(self, name: str) -> None:
        self.session.change(replace(self.session.state, harmonizer=name))

    def job_ended(self, job: JobState) -> None:
        """Show the result that a job has just made."""
        if self.editor.step == "Run" and job.command[:1] == ("run",) and job.outcome == "done":
            self.enter()

    def _said(self, session: Session) -> str:
        job = session.jobs.state()
        if job is not None and job.live:
            return "A result is being made; you can go on meanwhile."
        why = session.why_stale(self._last_step())
        if not session.files.result.is_file():
            return "There is no result yet."
        return "The result is up to date." if why is None else f"The result is out of date: {why}."

    def _last_step(self) -> str:
        return "evaluate" if self._with_report else "consolidate"


class SharePanel(Panel):
    """Controls to write a file by a job and send it to the editing window."""

    _kind = next(iter(SHARE_KINDS))
    _part: Layer = "all"
    _asked = 0
    """Process id of the job that writes a file for the window."""

    def build(self, form: Form) -> None:
        """Add the kinds of files, the command, and the list of files."""
        session, kind = self.session, self._kind
        is_report = kind == REPORT
        refused = why_not(session.files, kind)
        shown = step_shown(session.files, is_report=is_report)
        why = None if refused is not None else session.why_stale(shown)
        what = "The report" if is_report else "The result"
        form.note("" if why is None else f"{what} is out of date: {why}. See Run.", name="stale", bad=True)
        form.choice("kind_of_file", "As", kind, {name: name for name in SHARE_KINDS}, self._sets("_kind"))
        form.note(refused or "", name="share")
        form.button("write", "Write and download", self._start, main=True, disabled=refused is not None)
        form.button("view_picture", "Picture of this view", self._send_picture)
        form.links("written", self._links(session))
        form.more()
        if not is_report:
            hint = "Parts share the place's frame; pictures of them have alpha"
            form.choice("part", "Part", self._part, PARTS, self._sets("_part"), hint=hint)
        form.note(_command_line(self._wanted()[1]), name="command", faint=True)

    def _wanted(self) -> tuple[Path, tuple[str, ...]]:
        """Return the file to write and the arguments of `splatgraft` that write it."""
        session, to = self.session, export_path(self.session.files, self._kind, self._part)
        return to, session.project.export_words(to, "report" if self._kind == REPORT else self._part)

    def _start(self) -> None:
        (to, words), session = self._wanted(), self.session
        to.parent.mkdir(parents=True, exist_ok=True)
        session.jobs.start(words, f"Write {to.name}")
        job = session.jobs.state()
        self._asked = 0 if job is None else job.pid
        self.editor.say(f"{to.name}: being written; you can go on meanwhile")

    def job_ended(self, job: JobState) -> None:
        """Send the file that a job has written, and show the job's messages."""
        if job.command[:1] != ("export",):
            return
        asked, self._asked = self._asked, 0
        if job.outcome == "cancelled":
            self.editor.say(f"{job.title}: cancelled; nothing was written")
        if job.outcome != "done":
            return
        session, path = self.session, Path(job.command[job.command.index("--to") + 1])
        if asked == job.pid:
            self._offer(path)
        said = "; ".join(sentence.removeprefix(f"{path}: ") for sentence in job.said)
        why = session.why_stale(step_shown(session.files, is_report="--page" in job.command))
        stale = "" if why is None else f"; it is out of date ({why})"
        self.editor.say(f"written: {path}; {said}{stale}", bad=why is not None)

    def _offer(self, path: Path) -> None:
        number = 1 if self.editor.offer is None else self.editor.offer["n"] + 1
        self.editor.offer = {"n": number, "name": path.name, "url": _address(path)}

    def _send_picture(self) -> None:
        editor = self.editor
        view, path = editor.editing(), self.session.files.root / EXPORTS_FOLDER / _PICTURE
        if view is None:
            return
        camera = self.camera(view)
        pixels = editor.draw_target(replace(view, split=0.0), camera.resized(_SAVED_WIDTH / camera.width))[0]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, torch.from_numpy(pixels.astype(np.float32) / 255))
        self._offer(path)
        editor.say(f"written: {path}")

    def _links(self, session: Session) -> list[tuple[str, str, str | None, str]]:
        """List the shared files with their sizes, to open or download again."""
        files, rows = session.files, []
        newest = max((p.stat().st_mtime_ns for p in (files.result, files.relit) if p.is_file()), default=0)
        if has_report(files):
            rows.append(("The report", "", f"{FILES_PREFIX}{REPORT_FILE}", ""))
        for path in written_exports(files)[:_LISTED]:
            stat = path.stat()
            older = ", older than the result" if stat.st_mtime_ns < newest else ""
            opens = _address(path) if path.suffix in _SHOWN_SUFFIXES else None
            rows.append((path.name, f"{stat.st_size / 1e6:.1f} MB{older}", opens, _address(path)))
        return rows


def _address(path: Path) -> str:
    return f"{FILES_PREFIX}{EXPORTS_FOLDER}/{quote(path.name)}"


def _command_line(words: tuple[str, ...]) -> str:
    """Format the equivalent command."""
    return f"The same on the command line: {shlex.join(('splatgraft', *words))}"


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
