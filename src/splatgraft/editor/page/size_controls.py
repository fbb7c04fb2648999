"""The controls of a placed object's size in centimetres, and of the captures' metric scales that give it."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from splatgraft.editor.session import placement_operations
from splatgraft.editor.session.object_size import ObjectSize, set_own_scale, set_place_scale, size_of

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_STYLE = "font-size:.8em;line-height:1.5;padding:2px 12px;opacity:.8"
_SCALES = ("its capture", "the place")
_SAME = 0.002
"""Relative difference below which two sizes count as one."""


class SizeControls:
    """A height in centimetres where the target's scale is known, and a folder that sets both scales."""

    def __init__(self, page: Page) -> None:
        """Build the controls in the current folder of the panel."""
        self._page, gui = page, page.gui
        self._index = 0
        self._shown: float | None = None
        """What the field of the height shows; as `SelectPhase._shown_box`."""
        self._height = gui.add_number("Height, cm", 0.0, min=0.0, step=0.01, hint="Of the object, in the target")
        self._true_size = gui.add_button("As tall as it truly is", color="gray", visible=False)
        self._note = gui.add_html("")
        self._folder = gui.add_folder("Set the scale", expand_by_default=False)
        with self._folder:
            self._known = gui.add_number("True height, cm", 0.0, min=0.0, step=0.1, hint="Of the object, as measured")
            self._set = gui.add_button_group("Scale of", _SCALES)
        self._height.on_update(page.callback(lambda _: self._typed()))
        self._true_size.on_click(page.callback(lambda _: self._to_true_size()))
        self._set.on_click(page.callback(lambda event: self._set_scale(event.target.value)))

    def hide(self) -> None:
        """Hide all."""
        self._height.visible = self._true_size.visible = self._note.visible = self._folder.visible = False

    def show(self, index: int) -> None:
        """Show the size of one placed object."""
        self._index = index
        self._note.visible = self._folder.visible = True
        try:
            size = size_of(self._page.require_session(), index)
        except ValueError as error:
            self._height.visible = self._true_size.visible = False
            self._note.content = _note(str(error))
            return
        here, true = size.here_cm, size.true_cm
        self._height.visible = here is not None
        self._true_size.visible = here is not None and true is not None and abs(here / true - 1) > _SAME
        if here is not None and here != self._shown:
            self._shown = here
            self._height.value = round(here, 2)
        self._note.content = _note(_about(size))

    def _typed(self) -> None:
        self._shown = None  # so that the field goes back where this number is refused
        self._resize(float(self._height.value))

    def _to_true_size(self) -> None:
        true = size_of(self._page.require_session(), self._index).true_cm
        if true is not None:
            self._resize(true)

    def _resize(self, here_cm: float) -> None:
        session = self._page.require_session()
        scale = size_of(session, self._index).scale_at(here_cm)
        placed = session.objects()[self._index].target_from_object
        item = session.placeable_object(self._index)
        session.set_placement(self._index, placement_operations.rescale(item, placed, scale))

    def _set_scale(self, of: str) -> None:
        session, cm = self._page.require_session(), float(self._known.value)
        if of == _SCALES[0]:
            path = set_own_scale(session, self._index, cm)
            if size_of(session, self._index).place is not None:
                self._resize(cm)
        else:
            path = set_place_scale(session, self._index, cm)
        self._page.say(f"stored in {path}, as `splatgraft scale` does; Undo leaves it")


def _about(size: ObjectSize) -> str:
    """What is known of an object's size, and how to tell the rest."""
    parts = []
    if size.true_cm is not None and size.own is not None:
        parts.append(f"In its own capture it is {size.true_cm:.4g} cm tall, by {size.own.source}.")
    if size.place is not None:
        parts.append(f"The place has its scale from {size.place.source}.")
    if size.place is None:
        parts.append(
            "Its size in cm is not known, as the place has no scale: its size here is a guess. Set the scale below, "
            "by the object's true height, or by `splatgraft scale`."
        )
    elif size.own is None:
        parts.append("How tall it truly is, is not known: set the scale of its capture below.")
    return " ".join(parts)


def _note(text: str) -> str:
    return f'<div class="sg-size" style="{_STYLE}">{html.escape(text)}</div>'
