"""The phase `Run`: run the remaining steps, show which steps are stale, and share the results."""

from __future__ import annotations

import html
import shlex
from dataclasses import replace
from typing import TYPE_CHECKING

import viser

from splatgraft.editor.jobs import exports
from splatgraft.editor.page.place_phase import hide_target, show_target
from splatgraft.editor.page.server import FILES_PREFIX
from splatgraft.editor.page.share_panel import SharePanel
from splatgraft.harmonization import HARMONIZERS
from splatgraft.project.layout import REPORT_FILE

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_NOTE_STYLE = "font-size:.85em;line-height:1.5;padding:2px 12px;color:#e8590c"


class RunPhase:
    """The controls of the phase."""

    def __init__(self, page: Page) -> None:
        """Build the controls."""
        self._page, gui = page, page.gui
        self._is_active = False
        self._method = gui.add_dropdown("Image model", tuple(HARMONIZERS), initial_value="none")
        self._transfer = gui.add_button("Harmonise and consolidate", icon=viser.Icon.PLAYER_PLAY)
        self._report = gui.add_button("Make the report", color="gray")
        self._steps = gui.add_html("")
        with gui.add_folder("Share"):
            self._stale = gui.add_html("", visible=False)
            self._renew = gui.add_button("Bring the result up to date", icon=viser.Icon.REFRESH, visible=False)
            self._renew_report = gui.add_button(
                "Bring the report up to date", icon=viser.Icon.REFRESH, visible=False, color="gray"
            )
            self._share = SharePanel(page)
            self._link = gui.add_html("")
        callback = page.callback
        self._method.on_update(callback(lambda _: self._set_method()))
        self._transfer.on_click(callback(lambda _: page.run("consolidate", "Harmonise and consolidate")))
        self._report.on_click(callback(lambda _: page.run("evaluate", "Make the report")))
        self._renew.on_click(callback(lambda _: page.run("consolidate", "Bring the result up to date")))
        self._renew_report.on_click(callback(lambda _: page.run("evaluate", "Bring the report up to date")))

    def enter(self) -> None:
        """Show the target, and compare with the result in the preview."""
        self._is_active = True
        session = self._page.session
        if session is not None and session.files.target_scene.is_file():
            show_target(self._page)
        if session is not None and session.files.result.is_file():
            self._page.preview.show("Copy-paste", "Result")
        self.refresh()

    def leave(self) -> None:
        """Hide the target."""
        self._is_active = False
        hide_target(self._page)

    def refresh(self) -> None:
        """Update the table of steps and what can be shared."""
        session = self._page.session
        if session is None or not self._is_active:
            return
        self._method.value = session.state.harmonizer or "none"
        rows = []
        for name, reason in session.reasons().items():
            mark = "&#10003;" if reason is None else "&middot;"
            why = f'<td style="opacity:.6">{html.escape(reason or "")}</td>'
            rows.append(f'<tr><td style="width:1.4em">{mark}</td><td>{name}</td>{why}</tr>')
        shown = shlex.join(session.project.run_command("consolidate", "")[1])
        self._steps.content = (
            f'<div style="font-size:.8em;line-height:1.5;padding:2px 12px"><table>{"".join(rows)}</table>'
            f'<div style="opacity:.6;margin-top:6px">the same on the command line:</div>'
            f"<code>{html.escape(shown)}</code></div>"
        )
        has_report = exports.has_report(session.files)
        has_result = session.files.result.is_file()
        why_result = session.why_stale("consolidate") if has_result else None
        why_report = session.why_stale("evaluate") if has_report else None
        self._renew.visible, self._renew_report.visible = why_result is not None, why_report is not None
        self._stale.visible = bool(why_result or why_report)
        self._stale.content = _stale_note(why_result, why_report)
        link = f'<a href="{FILES_PREFIX}{REPORT_FILE}" target="_blank">Open the report</a>' if has_report else ""
        mark = " (out of date)" if why_report else ""
        self._share.refresh()
        self._link.content = f'<div style="font-size:.8em;line-height:1.5;padding:2px 12px">{link}{mark}</div>'

    def _set_method(self) -> None:
        session = self._page.require_session()
        session.change(replace(session.state, harmonizer=self._method.value))


def _stale_note(why_result: str | None, why_report: str | None) -> str:
    """What is out of date, and why."""
    rows = (("The result", why_result), ("The report", why_report))
    lines = [f"<b>{name}</b>: out of date ({html.escape(why)})" for name, why in rows if why is not None]
    return f'<div class="sg-stale" style="{_NOTE_STYLE}">{"<br>".join(lines)}</div>'
