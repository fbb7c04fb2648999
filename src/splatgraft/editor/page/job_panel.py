"""The long work that goes on: what it does, how far it is, the time left, a way to cancel it. Knows no kind of work."""

from __future__ import annotations

import html
import time
from typing import TYPE_CHECKING

import viser

from splatgraft.editor.jobs.jobs import JobState, seconds_left, seconds_left_in_all

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page


class JobPanel:
    """Shown while a job is at work, whoever started it and when."""

    def __init__(self, page: Page) -> None:
        """Build it."""
        self._page, gui = page, page.gui
        self._seen = ""
        self._text = gui.add_html("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._cancel = gui.add_button("Cancel", icon=viser.Icon.X, color="red", visible=False)
        self._cancel.on_click(page.act(lambda _: self._stop()))

    def refresh(self) -> None:
        """How far it is now; where a step of it has ended, the page shows what came out.

        Raises: ValueError where the job's state cannot be read.
        """
        state = None if self._page.session is None else self._page.session.job()
        live = state is not None and state.live
        self._text.visible = self._bar.visible = self._cancel.visible = live
        if state is None:
            return
        if live:
            self._show(state)
        seen = f"{state.pid} {state.outcome} {state.step}"
        if seen == self._seen:
            return
        ended, self._seen = bool(self._seen) and not live, seen
        if ended or state.outcome == "killed":
            self._say_end(state)
        self._page.redraw()

    def _show(self, state: JobState) -> None:
        now = time.time()
        whole, left = seconds_left_in_all(state, now), seconds_left(state, now)
        parts = [f"about {_minutes(whole)} left in all"] if whole is not None else []
        parts += [f"{_minutes(left)} in this step"] if left is not None else []
        rest = ", ".join(parts) or "time left not known yet"
        names = [step.name for step in state.plan]
        if state.step in names:
            rest += f" &middot; step {names.index(state.step) + 1} of {len(names)}"
        self._text.content = (
            f'<div class="sg-job" style="font-size:.85em;line-height:1.45;padding:2px 12px">'
            f"<b>{html.escape(state.title)}</b><br>"
            f"{html.escape(state.step or 'starting')}: {html.escape(state.message or '...')}<br>{rest}</div>"
        )
        self._bar.value = 100 * state.share

    def _say_end(self, state: JobState) -> None:
        sentences = {
            "done": "done",
            "failed": state.error,
            "cancelled": "cancelled; earlier results are whole, and the same run goes on from here",
            "killed": "ended without a word; start it again, it goes on from where it was",
        }
        bad = state.outcome in ("failed", "killed")
        self._page.say(f"{state.title}: {sentences.get(state.outcome, state.outcome)}", bad=bad)

    def _stop(self) -> None:
        self._page.need().jobs.cancel()
        self._page.say("asked to stop")


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
