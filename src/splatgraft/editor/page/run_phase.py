"""The phase `Run`: makes the result of the edits, or makes it again."""

import html
import shlex
from dataclasses import replace

import viser

from splatgraft.editor.jobs import JobState
from splatgraft.editor.page.context import PageContext, Phase, note
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.session import Session
from splatgraft.harmonization import HARMONIZERS

_LABEL = "Update result"


class RunPhase(Phase):
    """The controls of the phase."""

    def __init__(self, context: PageContext, preview: PreviewPanel) -> None:
        """Build the controls."""
        self._context, self._preview, gui = context, preview, context.gui
        self._note = gui.add_html("")
        context.on(gui.add_button(_LABEL, icon=viser.Icon.PLAYER_PLAY), self._run)
        with context.more_of("Run"):
            self._method = context.on(
                gui.add_dropdown("Image model", tuple(HARMONIZERS), initial_value="none"), self._set_method
            )
            self._with_report = gui.add_checkbox("With the report", False, hint="A page with numbers and pictures")
            self._command = gui.add_html("")
        context.on(self._with_report, lambda: None)

    def enter(self) -> None:
        """Compare with the result in the preview."""
        session = self._context.session
        if session is not None and session.files.result.is_file():
            self._preview.show("Copy-paste", "Result")

    def refresh(self) -> None:
        """Update the target, and say whether the result is that of the edits."""
        session = self._context.session
        if session is None:
            return
        self._context.show_target()
        self._method.value = session.state.harmonizer or "none"
        self._note.content = note(self._said(session), kind="result")
        self._command.content = command_line(session.project.run_words(self._last_step()))

    def job_ended(self, job: JobState) -> None:
        """Show the result that a job has just made."""
        if self._context.phase == "Run" and job.command[:1] == ("run",) and job.outcome == "done":
            self.enter()

    def _said(self, session: Session) -> str:
        job = session.jobs.state()
        if job is not None and job.live:
            return "A result is being made; you can go on meanwhile."
        why = session.why_stale(self._last_step())
        if not session.files.result.is_file():
            return "There is no result yet."
        return "The result is up to date." if why is None else f"The result is out of date: {html.escape(why)}."

    def _last_step(self) -> str:
        return "evaluate" if self._with_report.value else "consolidate"

    def _run(self) -> None:
        self._context.run(self._last_step(), _LABEL)

    def _set_method(self) -> None:
        session = self._context.require_session()
        session.change(replace(session.state, harmonizer=self._method.value))


def command_line(words: tuple[str, ...]) -> str:
    """HTML of a command that does the same."""
    shown = html.escape(shlex.join(("splatgraft", *words)))
    return note(
        f'the same on the command line:<br><code style="overflow-wrap:anywhere">{shown}</code>',
        kind="command",
        faint=True,
    )
