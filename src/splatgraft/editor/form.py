"""A panel's controls as a value: steps rebuild them after every change, and the page draws the differences.

A control's handler is called with a browser's value only if the control offers that value.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

Handler = Callable[[Any], object]
_MAX_TEXT = 4096  # characters; paths are shorter on all systems


class Form:
    """Controls in order, with their handlers."""

    def __init__(self) -> None:
        """Start without controls."""
        self.controls: list[dict[str, Any]] = []
        """Controls for the page to draw; `editor.js` defines their kinds."""
        self._handlers: dict[str, tuple[Handler, Handler]] = {}
        """Check of a value and handler of the checked value, by control."""
        self._live: dict[str, Handler] = {}
        self._is_more = False

    def more(self) -> None:
        """Put the controls that follow under `More`."""
        self._is_more = True

    def note(self, text: str, *, name: str = "note", bad: bool = False, faint: bool = False) -> None:
        """Add a paragraph unless the text is empty."""
        if text:
            self._add("note", name, text=text, bad=bad, faint=faint)

    def button(
        self, name: str, label: str, work: Callable[[], object], *, main: bool = False, disabled: bool = False
    ) -> None:
        """Add a button; `main` marks the one that continues the step."""
        self._add("button", name, label=label, main=main, disabled=disabled)
        if not disabled:
            self.hidden(name, work)

    def buttons(self, name: str, choices: Mapping[str, Callable[[], object]]) -> None:
        """Add a row of buttons."""
        self._add("buttons", name, options=list(choices))
        self._handle(name, _one_of(list(choices)), lambda value: choices[value]())

    def check(self, name: str, label: str, value: bool, work: Handler, *, hint: str = "") -> None:
        """Add a checkbox."""
        self._add("check", name, label=label, value=value, hint=hint)
        self._handle(name, _one_of([False, True]), work)

    def choice(
        self, name: str, label: str, value: Any, options: Mapping[str, Any], work: Handler, *, hint: str = ""
    ) -> None:
        """Add a menu of values by their labels; it shows the first label if `value` has none."""
        shown = next((key for key, option in options.items() if option == value), next(iter(options)))
        self._add("choice", name, label=label, value=shown, options=list(options), hint=hint)
        self._handle(name, _one_of(list(options)), lambda key: work(options[key]))

    def slider(
        self, name: str, label: str, value: float, ends: tuple[float, float, float], work: Handler, *, hint: str = ""
    ) -> None:
        """Add a slider; `ends` are its minimum, maximum and step."""
        low, high, step = ends
        self._add("slider", name, label=label, value=value, min=low, max=high, step=step, hint=hint)

        def checked(value: Any) -> Any:
            if not low <= _number(value) <= high:
                raise ValueError("expected a number on the slider")
            return value

        self._handle(name, checked, work)

    def numbers(
        self, name: str, label: str, values: Sequence[float], work: Handler, *, step: float = 0.001, hint: str = ""
    ) -> None:
        """Add number fields; the handler gets a tuple and rejects impossible values."""
        self._add("numbers", name, label=label, value=list(values), step=step, hint=hint)

        def checked(given: Any) -> tuple[float, ...]:
            if not isinstance(given, list) or len(given) != len(values):
                raise ValueError("expected as many numbers as there are fields")
            return tuple(_number(value) for value in given)

        self._handle(name, checked, work)

    def number(
        self, name: str, label: str, value: float, work: Handler, *, step: float = 0.001, hint: str = ""
    ) -> None:
        """Add one number field."""
        self.numbers(name, label, [value], lambda values: work(values[0]), step=step, hint=hint)

    def text(self, name: str, label: str, value: str, work: Handler, *, hint: str = "", browse: bool = False) -> None:
        """Add a text field; `browse` adds a button that opens the folders of this machine."""
        self._add("text", name, label=label, value=value, hint=hint, browse=browse)
        self._handle(name, _text, work)

    def hidden(self, name: str, work: Callable[[], object]) -> None:
        """Add a handler for part of another control, such as its button `browse`."""
        self._handle(name, lambda value: None, lambda _: work())

    def rows(self, name: str, rows: Sequence[str], work: Handler) -> None:
        """Add a list of clickable lines."""
        self._add("rows", name, options=list(rows))
        self._handle(name, _one_of(rows), work)

    def upload(self, name: str, label: str, suffixes: Sequence[str], *, many: bool = False) -> None:
        """Add an upload button and a drop area; the files are sent by separate requests."""
        self._add("upload", name, label=label, accept=",".join(suffixes), many=many)

    def drawing(self, name: str, svg: str, work: Handler) -> None:
        """Add an SVG with draggable dots; the handler gets the dot's number, x, y and whether the drag has ended."""
        self._add("drawing", name, svg=svg)

        def checked(given: Any) -> tuple[int, float, float, bool]:
            index, x, y, is_end = given
            if not (isinstance(index, int) and isinstance(is_end, bool) and math.hypot(_number(x), _number(y)) < 2):
                raise ValueError("expected a place in the drawing")
            return index, float(x), float(y), is_end

        self._handle(name, checked, work)
        self.while_dragged(name, work)

    def progress(self, name: str, share: float) -> None:
        """Add a progress bar; `share` is in [0, 1]."""
        self._add("progress", name, value=round(share, 3))

    def links(self, name: str, links: Sequence[tuple[str, str, str | None, str]]) -> None:
        """Add files: name, remark, address to open or None, address to download or an empty string."""
        if links:
            self._add("links", name, options=[list(link) for link in links])

    def while_dragged(self, name: str, work: Handler) -> None:
        """Call `work` with the values of a slider or drawing while it is dragged."""
        self._live[name] = work

    def take(self, name: str, value: Any, *, live: bool = False) -> None:
        """Call the handler of a control with a value that a browser sent, also `live` ones of a drag.

        Nothing is done if there is no such control or it does not offer that value, because the panel may have changed
        meanwhile. Raise ValueError if the handler refuses the value.
        """
        try:
            check, work = self._handlers[name]
            work = self._live[name] if live else work
            value = check(value)
        except (ValueError, TypeError, KeyError):
            return
        work(value)

    def _add(self, kind: str, name: str, **properties: Any) -> None:
        given = {key: value for key, value in properties.items() if value is not False and value != ""}
        self.controls.append({"kind": kind, "id": name, **given, **({"more": True} if self._is_more else {})})

    def _handle(self, name: str, check: Handler, work: Handler) -> None:
        self._handlers[name] = (check, work)


def _one_of(options: Sequence[Any]) -> Callable[[Any], Any]:
    def checked(value: Any) -> Any:
        if not any(type(value) is type(option) and value == option for option in options):
            raise ValueError("expected one of the options")
        return value

    return checked


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError("expected a number")
    return float(value)


def _text(value: Any) -> str:
    if not isinstance(value, str) or len(value) > _MAX_TEXT or "\x00" in value:
        raise ValueError("expected a line of text")
    return value
