"""The panel `Share`: writes the result in any format of `export` in a job, and sends the file to the window."""

from __future__ import annotations

import html
import shlex
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import viser

from splatgraft.editor.jobs import exports
from splatgraft.editor.jobs.jobs import JobState
from splatgraft.editor.page.server import FILES_PREFIX
from splatgraft.editor.session.project_access import ExportPage
from splatgraft.exports.export import Layer
from splatgraft.project.layout import EXPORTS_FOLDER

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_STYLE = "font-size:.8em;line-height:1.5;padding:2px 12px"
_LISTED = 6
"""Shared files that are listed, the newest ones."""


class SharePanel:
    """The controls, the command that does the same, and the files that were written."""

    def __init__(self, page: Page) -> None:
        """Build the controls in the current folder of the panel."""
        self._page, gui = page, page.gui
        self._asked: tuple[int, int] | None = None
        """The process of the job that writes a file, and the window that asked for it."""
        kinds, parts = tuple(exports.SHARE_KINDS), tuple(exports.PARTS)
        self._kind = gui.add_dropdown("As", kinds, initial_value=kinds[0])
        self._part = gui.add_dropdown(
            "Part", parts, initial_value=parts[0], hint="Parts share the target's frame; pictures of them have alpha"
        )
        self._note = gui.add_html("", visible=False)
        self._write = gui.add_button("Write and download", icon=viser.Icon.SHARE)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._picture = gui.add_button("Picture of this view", icon=viser.Icon.PHOTO, color="gray")
        self._written = gui.add_html("")
        self._kind.on_update(page.callback(lambda _: None))
        self._part.on_update(page.callback(lambda _: None))
        self._write.on_click(page.callback(self._start))
        self._picture.on_click(page.callback(self._send_picture))
        page.job.on_progress, page.job.on_end = self._show_progress, self._job_ended

    def refresh(self) -> None:
        """Update what can be written, the command and the list of files."""
        session = self._page.session
        if session is None:
            return
        files, kind = session.files, exports.SHARE_KINDS[self._kind.value]
        self._part.visible = kind.has_parts
        missing = exports.missing_package(kind)
        exists = exports.has_report(files) if kind.page == "report" else exports.has_scene(files)
        if missing is None and not exists:
            missing = "There is no report yet." if kind.page == "report" else "There is no result yet."
        self._write.disabled = missing is not None
        self._note.visible, self._note.content = True, f'<div class="sg-share" style="{_STYLE}">{missing or ""}</div>'
        if missing is None:
            to, page, layer = self._wanted()
            shown = html.escape(shlex.join(session.project.export_command(to, page=page, layer=layer, title="")[1]))
            self._note.content = (
                f'<div class="sg-share" style="{_STYLE}"><div style="opacity:.6">the same on the command line:</div>'
                f'<code style="overflow-wrap:anywhere">{shown}</code></div>'
            )
        self._written.content = f'<div style="{_STYLE}">{self._list()}</div>'

    def _wanted(self) -> tuple[Path, ExportPage, Layer]:
        """The file to write, and what it holds."""
        kind = exports.SHARE_KINDS[self._kind.value]
        layer = exports.PARTS[self._part.value] if kind.has_parts else "all"
        return exports.export_path(self._page.require_session().files, kind, layer), kind.page, layer

    def _start(self, event: viser.GuiEvent) -> None:
        to, page, layer = self._wanted()
        job = self._page.require_session().export(to, page=page, layer=layer, title=f"Write {to.name}")
        if job is not None and event.client is not None:
            self._asked = (job.pid, event.client.client_id)
        self._page.say(f"{to.name}: being written; you can go on meanwhile")
        self._page.job.refresh()

    def _show_progress(self, job: JobState) -> None:
        """Show the progress here too: the panel of the job is out of view."""
        self._bar.visible = _is_export(job)
        self._bar.value = 100 * job.fraction

    def _job_ended(self, job: JobState) -> None:
        """Send the file that a job has written to the window that asked for it, and say what the job said."""
        self._bar.visible = False
        if not _is_export(job):
            return
        asked, self._asked = self._asked, None
        if job.outcome == "cancelled":
            self._page.say(f"{job.title}: cancelled; nothing was written")
        if job.outcome != "done":
            return
        session, path = self._page.require_session(), Path(job.command[job.command.index("--to") + 1])
        window = None if asked is None or asked[0] != job.pid else self._page.server.get_clients().get(asked[1])
        if window is not None:
            window.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        said = "; ".join(sentence.removeprefix(f"{path}: ") for sentence in job.said)
        why = session.why_stale(exports.step_shown(session.files, is_report="--page" in job.command))
        note = "" if why is None else f"; it is out of date ({why})"
        self._page.say(f"written: {path}; {said}{note}", bad=why is not None)

    def _send_picture(self, event: viser.GuiEvent) -> None:
        path = exports.picture_path(self._page.require_session().files, "view")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._page.preview.save_picture(path)
        if event.client is not None:
            event.client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        self._page.say(f"written: {path}")

    def _list(self) -> str:
        """The shared files with their sizes, to be opened or downloaded again."""
        files = self._page.require_session().files
        newest = max((p.stat().st_mtime_ns for p in (files.result, files.relit) if p.is_file()), default=0)
        rows = []
        for path in exports.written_exports(files)[:_LISTED]:
            address, stat = f"{FILES_PREFIX}{EXPORTS_FOLDER}/{quote(path.name)}", path.stat()
            name = html.escape(path.name)
            is_shown = path.suffix in (".html", ".png", ".jpg", ".webp", ".gif", ".mp4")
            link = f'<a href="{address}" target="_blank">open</a> ' if is_shown else ""
            older = " (older than the result)" if stat.st_mtime_ns < newest else ""
            rows.append(f'{name}, {stat.st_size / 1e6:.1f} MB {link}<a href="{address}" download>download</a>{older}')
        return "<br>".join(rows)


def _is_export(job: JobState) -> bool:
    return job.command[:1] == ("export",)
