"""Keys of the page: a list of them on `?`, and the phases on 1 to 5."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_KEYS = (
    ("1 to 5", "Open, Select, Place, Light, Run"),
    ("Ctrl+Z, Ctrl+Shift+Z", "undo, redo"),
    ("Left, Right", "previous and next camera of the scene"),
    ("B", "Select: brush on or off"),
    ("Shift and drag", "Select: a rectangle"),
    ("G", "Place: drop the object to the surface"),
    ("S", "Place: snap on or off"),
    ("D, Delete", "Place: duplicate or delete the object"),
    ("?", "this list"),
)
_NUMBERS = ("1", "2", "3", "4", "5")


class Keys:
    """The keys that belong to no phase."""

    def __init__(self, page: Page, phases: tuple[str, ...]) -> None:
        """Add them to the page."""
        self._page = page
        self._list: Any = None
        for number, phase in zip(_NUMBERS, phases, strict=True):
            command = page.gui.add_command(f"Step {phase}", hotkey=number)
            command.on_trigger(page.callback(lambda _, phase=phase: page.show_phase(phase)))
        # viser's page takes any key of the browser; its types name letters, digits and a few others
        question: Any = "?"
        command = page.gui.add_command("List of keys", hotkey=question, modifier="shift")
        command.on_trigger(page.callback(lambda _: self._show_list()))

    def _show_list(self) -> None:
        if self._list is not None:
            self._close()
            return
        gui = self._page.gui
        self._list = gui.add_modal("Keys")
        with self._list:
            rows = "\n".join(f"| {key} | {meaning} |" for key, meaning in _KEYS)
            gui.add_markdown(f"| key | what it does |\n| --- | --- |\n{rows}")
            gui.add_button("Close").on_click(self._page.callback(lambda _: self._close()))

    def _close(self) -> None:
        if self._list is not None:
            self._list.close()
            self._list = None
