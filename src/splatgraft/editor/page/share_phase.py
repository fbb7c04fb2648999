"""The phase `Share`: writes the result, or a part of it, in any format of `export`."""

import html
from pathlib import Path
from urllib.parse import quote

import viser

from splatgraft.editor import sharing
from splatgraft.editor.jobs import JobState
from splatgraft.editor.page.context import PageContext, Phase, note
from splatgraft.editor.page.job_panel import JobPanel
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.run_phase import command_line
from splatgraft.editor.page.server import FILES_PREFIX
from splatgraft.editor.project import ExportPage
from splatgraft.exports.export import Layer
from splatgraft.project.layout import EXPORTS_FOLDER, REPORT_FILE

_LISTED = 6
"""Shared files that are listed, the newest ones."""
_SHOWN_SUFFIXES = (".html", ".png", ".jpg", ".webp", ".gif", ".mp4")
"""Suffixes of files that a browser shows."""
_PICTURE = "view.png"


class SharePhase(Phase):
    """The controls of the phase. A job writes the file, which is then sent to the window that asked for it."""

    def __init__(self, context: PageContext, preview: PreviewPanel, job: JobPanel) -> None:
        """Build the controls."""
        self._context, self._preview, gui = context, preview, context.gui
        self._stale = gui.add_html("", visible=False)
        self._asked: tuple[int, int] | None = None
        """The process of the job that writes a file, and the window that asked for it."""
        self._kind = context.on(gui.add_dropdown("As", tuple(sharing.SHARE_KINDS)), lambda: None)
        self._note = gui.add_html("")
        self._write = gui.add_button("Write and download", icon=viser.Icon.SHARE)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._picture = gui.add_button("Picture of this view", icon=viser.Icon.PHOTO, color="gray")
        self._written = gui.add_html("")
        with context.more_of("Share"):
            self._part = gui.add_dropdown(
                "Part", tuple(sharing.PARTS), hint="Parts share the place's frame; pictures of them have alpha"
            )
            self._command = gui.add_html("")
        context.on(self._part, lambda: None)
        self._write.on_click(context.callback(self._start))
        self._picture.on_click(context.callback(self._send_picture))
        job.on_progress = self._show_progress

    def refresh(self) -> None:
        """Update the target, what can be written, the command and the list of files."""
        session = self._context.session
        if session is None:
            return
        self._context.show_target()
        kind = sharing.SHARE_KINDS[self._kind.value]
        self._part.visible = kind.page == "viewer"
        why_not = sharing.why_not(session.files, kind)
        self._write.disabled = why_not is not None
        to, page, layer = self._wanted()
        self._note.content = note(html.escape(why_not or ""), kind="share")
        self._command.content = command_line(session.project.export_words(to, page=page, layer=layer))
        shown = sharing.step_shown(session.files, is_report=page == "report")
        why = None if why_not is not None else session.why_stale(shown)
        self._stale.visible = why is not None
        what = "The report" if page == "report" else "The result"
        self._stale.content = note(f"{what} is out of date: {html.escape(why or '')}. See Run.", kind="stale", bad=True)
        self._written.content = note(self._list())

    def _wanted(self) -> tuple[Path, ExportPage, Layer]:
        """The file to write, and what it holds."""
        kind = sharing.SHARE_KINDS[self._kind.value]
        layer = sharing.PARTS[self._part.value] if kind.page == "viewer" else "all"
        return sharing.export_path(self._context.require_session().files, kind, layer), kind.page, layer

    def _start(self, event: viser.GuiEvent) -> None:
        to, page, layer = self._wanted()
        session = self._context.require_session()
        to.parent.mkdir(parents=True, exist_ok=True)
        session.start_job(session.project.export_words(to, page=page, layer=layer), f"Write {to.name}")
        job = session.jobs.state()
        if job is not None and event.client is not None:
            self._asked = (job.pid, event.client.client_id)
        self._context.say(f"{to.name}: being written; you can go on meanwhile")

    def _show_progress(self, job: JobState) -> None:
        """Show the progress here too: the panel of the job is out of view."""
        self._bar.visible = job.command[0] == "export"
        self._bar.value = 100 * job.fraction

    def job_ended(self, job: JobState) -> None:
        """Send the file that a job has written to the window that asked for it, and say what the job said."""
        self._bar.visible = False
        if job.command[:1] != ("export",):
            return
        asked, self._asked = self._asked, None
        if job.outcome == "cancelled":
            self._context.say(f"{job.title}: cancelled; nothing was written")
        if job.outcome != "done":
            return
        session, path = self._context.require_session(), Path(job.command[job.command.index("--to") + 1])
        window = None if asked is None or asked[0] != job.pid else self._context.server.get_clients().get(asked[1])
        if window is not None:
            window.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        said = "; ".join(sentence.removeprefix(f"{path}: ") for sentence in job.said)
        why = session.why_stale(sharing.step_shown(session.files, is_report="--page" in job.command))
        stale = "" if why is None else f"; it is out of date ({why})"
        self._context.say(f"written: {path}; {said}{stale}", bad=why is not None)

    def _send_picture(self, event: viser.GuiEvent) -> None:
        path = self._context.require_session().files.root / EXPORTS_FOLDER / _PICTURE
        path.parent.mkdir(parents=True, exist_ok=True)
        self._preview.save_picture(path)
        if event.client is not None:
            event.client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        self._context.say(f"written: {path}")

    def _list(self) -> str:
        """The shared files with their sizes, to be opened or downloaded again."""
        files = self._context.require_session().files
        has_report = sharing.has_report(files)
        newest = max((p.stat().st_mtime_ns for p in (files.result, files.relit) if p.is_file()), default=0)
        rows = [f'<a href="{FILES_PREFIX}{REPORT_FILE}" target="_blank">Open the report</a>'] if has_report else []
        for path in sharing.written_exports(files)[:_LISTED]:
            address, stat = f"{FILES_PREFIX}{EXPORTS_FOLDER}/{quote(path.name)}", path.stat()
            link = f'<a href="{address}" target="_blank">open</a> ' if path.suffix in _SHOWN_SUFFIXES else ""
            older = " (older than the result)" if stat.st_mtime_ns < newest else ""
            rows.append(
                f"{html.escape(path.name)}, {stat.st_size / 1e6:.1f} MB "
                f'{link}<a href="{address}" download>download</a>{older}'
            )
        return "<br>".join(rows)
