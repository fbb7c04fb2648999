"""Undo and redo: buttons and keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from splatgraft.editor.session.session import Session

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_NAMES = ("Undo", "Redo")


class HistoryControls:
    """The two buttons, visible where there is a step to go to."""

    def __init__(self, page: Page) -> None:
        """Build the buttons in the current folder of the panel, and the keys."""
        self._page, gui = page, page.gui
        self._buttons = gui.add_button_group("History", _NAMES)
        self._buttons.on_click(
            page.callback(lambda event: self._undo() if event.target.value == _NAMES[0] else self._redo())
        )
        undo = gui.add_command("Undo", hotkey="Z", modifier="cmd/ctrl")
        redo = gui.add_command("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        undo.on_trigger(page.callback(lambda _: self._undo()))
        redo.on_trigger(page.callback(lambda _: self._redo()))

    def refresh(self) -> None:
        """Show the buttons where there is anything to undo or redo."""
        session = self._page.session
        self._buttons.visible = session is not None and session.has_steps()

    def _undo(self) -> None:
        self._step(Session.undo, "undone", "nothing to undo")

    def _redo(self) -> None:
        self._step(Session.redo, "redone", "nothing to redo")

    def _step(self, move: Callable[[Session], bool], done: str, nothing: str) -> None:
        session = self._page.require_session()
        session.notice = None
        self._page.say(done if move(session) else nothing)
        self._page.say_notice()
