"""The method by which a notebook (IPython) shows a value as a picture."""

from importlib import import_module
from typing import Any


def draw_in_notebook(value: Any) -> bytes | None:
    """Draw a value as a PNG, or return None if it has no picture; a class takes it as its method `_repr_png_`.

    The module that draws is loaded by name, because it uses the renderer, which lies above the values.
    """
    return import_module("splatgraft.exports.notebook").picture_of(value)
