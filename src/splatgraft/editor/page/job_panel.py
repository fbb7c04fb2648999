"""The panel of the running job: step, progress, remaining time and a cancel button."""

import html
import time
from collections.abc import Callable

import viser

from splatgraft.editor.jobs import JobState, seconds_left, seconds_left_in_job
from splatgraft.editor.page.context import PageContext, note


class JobPanel:
    """Visible while a job of this project runs, also one that an earlier page started."""

    def __init__(self, context: PageContext) -> None:
        """Build the controls."""
        self._context, gui = context, context.gui
        self._last_seen = ""
        self.on_progress: Callable[[JobState], None] = lambda state: None
        """Called with the state of the running job, a few times a second."""
        self.on_end: Callable[[JobState], None] = lambda state: None
        """Called with the state of a job that has ended, after the page has been redrawn."""
        self._text = gui.add_html("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._cancel = context.on(gui.add_button("Cancel", icon=viser.Icon.X, color="red", visible=False), self._stop)

    def refresh(self) -> None:
        """Update the panel; redraw the page when a step has ended."""
        state = None if self._context.session is None else self._context.session.jobs.state()
        live = state is not None and state.live
        self._text.visible = self._bar.visible = self._cancel.visible = live
        if state is None:
            return
        if live:
            self._show(state)
            self.on_progress(state)
        current = f"{state.pid} {state.outcome} {state.step}"
        if current == self._last_seen:
            return
        ended, self._last_seen = bool(self._last_seen) and not live, current
        if ended or state.outcome == "killed":
            self._say_end(state)
        self._context.refresh()
        if ended:
            self.on_end(state)

    def _show(self, state: JobState) -> None:
        now = time.time()
        whole, left = seconds_left_in_job(state, now), seconds_left(state, now)
        parts = [f"about {_minutes(left)} left in this step"] if left is not None else []
        parts += [f"about {_minutes(whole)} in all"] if whole is not None else []
        rest = ", ".join(parts) or "time left: not measured yet"
        names = [step.name for step in state.plan]
        if state.step in names:
            rest += f" &middot; step {names.index(state.step) + 1} of {len(names)}"
        message = html.escape(state.message or "...")
        at, rows = names.index(state.step) if state.step in names else -1, []
        for index, name in enumerate(names):
            mark = "&#10003;" if index < at else "&#9679;" if index == at else "&middot;"
            rows.append(f"{mark} {html.escape(name)}{f': {message}' if index == at else ''}")
        steps = "<br>".join(rows) if at >= 0 else f"{html.escape(state.step or 'starting')}: {message}"
        self._text.content = note(f"<b>{html.escape(state.title)}</b><br>{rest}<br>{steps}", kind="job")
        self._bar.value = 100 * state.fraction

    def _say_end(self, state: JobState) -> None:
        sentences = {
            "done": "done",
            "failed": state.error,
            "cancelled": "cancelled; finished steps are kept, and the same run resumes from here",
            "killed": "the process ended unexpectedly; start it again, it resumes from where it was",
        }
        bad = state.outcome in ("failed", "killed")
        self._context.say(f"{state.title}: {sentences.get(state.outcome, state.outcome)}", bad=bad)

    def _stop(self) -> None:
        self._context.require_session().jobs.cancel()
        self._context.say("stopping")


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
