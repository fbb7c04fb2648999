"""The steps `Run` and `Share`: compute the result of the edits, and export it or a part of it."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
import torch

from splatgraft.core.images import write_image
from splatgraft.editor import sharing
from splatgraft.editor.form import Form
from splatgraft.editor.jobs import JobState
from splatgraft.editor.panel import Panel, view_camera
from splatgraft.editor.project import ExportPage
from splatgraft.editor.server import FILES_PREFIX
from splatgraft.editor.session import Session
from splatgraft.exports.export import Layer
from splatgraft.harmonization import HARMONIZERS
from splatgraft.project.layout import EXPORTS_FOLDER, REPORT_FILE

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

_LABEL = "Update result"
_LISTED = 6  # number of listed shared files, newest first
_SHOWN_SUFFIXES = (".html", ".png", ".jpg", ".webp", ".gif", ".mp4")
_PICTURE, _SAVED_WIDTH = "view.png", 1280


class RunPanel(Panel):
    """Controls to compute the result of the edits."""

    def __init__(self, editor: "Editor") -> None:
        """Start without the report."""
        super().__init__(editor)
        self._with_report = False

    def enter(self) -> None:
        """Show the result, if it exists."""
        session = self.editor.session
        if session is not None and session.files.result.is_file():
            self.editor.before, self.editor.kind = "Pasted, unlit", "Result"

    def build(self, form: Form) -> None:
        """Say whether the result is up to date, and add the controls."""
        session = self.editor.require_session()
        form.note(self._said(session), name="result")
        form.button("run", _LABEL, lambda: self.editor.run(self._last_step(), _LABEL), main=True)
        form.more()
        method = session.state.harmonizer or "none"
        form.choice(
            "method", "Image model", method, tuple(HARMONIZERS),
            lambda value: session.change(replace(session.state, harmonizer=value)),
        )  # fmt: skip
        form.check("with_report", "With the report", self._with_report, self._set_report, hint="Numbers and pictures")
        form.note(_command_line(session.project.run_words(self._last_step())), name="command", faint=True)

    def _set_report(self, value: bool) -> None:
        self._with_report = value

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

    def __init__(self, editor: "Editor") -> None:
        """Start with the first kind of file and the first part."""
        super().__init__(editor)
        self._kind, self._part = next(iter(sharing.SHARE_KINDS)), next(iter(sharing.PARTS))
        self._asked = 0
        """Process id of the job that writes a file for the window."""

    def build(self, form: Form) -> None:
        """Add the kinds of files, the command, and the list of files."""
        session = self.editor.require_session()
        kind = sharing.SHARE_KINDS[self._kind]
        why_not = sharing.why_not(session.files, kind)
        to, page, layer = self._wanted()
        shown = sharing.step_shown(session.files, is_report=page == "report")
        why = None if why_not is not None else session.why_stale(shown)
        what = "The report" if page == "report" else "The result"
        form.note("" if why is None else f"{what} is out of date: {why}. See Run.", name="stale", bad=True)
        form.choice("kind_of_file", "As", self._kind, tuple(sharing.SHARE_KINDS), lambda v: setattr(self, "_kind", v))
        form.note(why_not or "", name="share")
        form.button("write", "Write and download", self._start, main=True, disabled=why_not is not None)
        job = session.jobs.state()
        if job is not None and job.live and job.command[:1] == ("export",):
            form.progress("export", job.fraction)
        form.button("view_picture", "Picture of this view", self._send_picture)
        form.links("written", self._links(session))
        form.more()
        if kind.page == "viewer":
            form.choice(
                "part", "Part", self._part, tuple(sharing.PARTS), lambda value: setattr(self, "_part", value),
                hint="Parts share the place's frame; pictures of them have alpha",
            )  # fmt: skip
        form.note(_command_line(session.project.export_words(to, page=page, layer=layer)), name="command", faint=True)

    def _wanted(self) -> tuple[Path, ExportPage, Layer]:
        """Return the file to write, its page and its layer."""
        kind = sharing.SHARE_KINDS[self._kind]
        layer = sharing.PARTS[self._part] if kind.page == "viewer" else "all"
        return sharing.export_path(self.editor.require_session().files, kind, layer), kind.page, layer

    def _start(self) -> None:
        to, page, layer = self._wanted()
        session = self.editor.require_session()
        to.parent.mkdir(parents=True, exist_ok=True)
        session.start_job(session.project.export_words(to, page=page, layer=layer), f"Write {to.name}")
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
        session, path = self.editor.require_session(), Path(job.command[job.command.index("--to") + 1])
        if asked == job.pid:
            self._offer(path)
        said = "; ".join(sentence.removeprefix(f"{path}: ") for sentence in job.said)
        why = session.why_stale(sharing.step_shown(session.files, is_report="--page" in job.command))
        stale = "" if why is None else f"; it is out of date ({why})"
        self.editor.say(f"written: {path}; {said}{stale}", bad=why is not None)

    def _offer(self, path: Path) -> None:
        number = 1 if self.editor.offer is None else self.editor.offer["n"] + 1
        self.editor.offer = {"n": number, "name": path.name, "url": _address(path)}

    def _send_picture(self) -> None:
        editor = self.editor
        view, path = editor.editing(), editor.require_session().files.root / EXPORTS_FOLDER / _PICTURE
        if view is None:
            return
        camera = view_camera(editor, view)
        pixels = editor.draw_target(replace(view, split=0.0), camera.resized(_SAVED_WIDTH / camera.width))[0]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, torch.from_numpy(pixels.astype(np.float32) / 255))
        self._offer(path)
        editor.say(f"written: {path}")

    def _links(self, session: Session) -> list[tuple[str, str, str | None, str]]:
        """List the shared files with their sizes, to open or download again."""
        files, rows = session.files, []
        newest = max((p.stat().st_mtime_ns for p in (files.result, files.relit) if p.is_file()), default=0)
        if sharing.has_report(files):
            rows.append(("The report", "", f"{FILES_PREFIX}{REPORT_FILE}", ""))
        for path in sharing.written_exports(files)[:_LISTED]:
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
