"""The base of the editor's steps: a panel, a picture with its overlay, and actions of the pointer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.drag import Corner, on_canvas
from splatgraft.editor.form import Form
from splatgraft.editor.jobs import JobState
from splatgraft.editor.picking import Ray, first_surface_hit
from splatgraft.editor.session import Session
from splatgraft.editor.stream import View
from splatgraft.segmentation import Box

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

CORNERS = ("lower", "upper")
"""Names of the dots by which a box is dragged."""
_SHORTEST = 1e-4  # shortest edge of a dragged box over its longest; the volume stays positive
_BOX_EDGES = [(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1]


@dataclass(frozen=True)
class Pointer:
    """An action of the pointer on the canvas."""

    what: str
    """Kind: down, move, up, cancel, click, or rectangle."""
    place: tuple[float, float]
    """Position over the canvas's sides."""
    on: str = ""
    """Name of the object or dot that was grabbed; empty if there was none."""
    mode: str = "move"
    """Drag mode of an object."""
    alt: bool = False
    """Whether Alt or the right button was held."""
    shift: bool = False
    """Whether Shift was held."""
    to: tuple[float, float] = (0.0, 0.0)
    """The other corner of a rectangle."""

    @staticmethod
    def of(message: dict[str, Any]) -> Pointer:
        """Parse a browser's message; raise ValueError, KeyError or TypeError if it is invalid."""
        x, y, u, v = (float(message.get(name, 0.0)) for name in ("x", "y", "u", "v"))
        # a pointer may leave the canvas, and a message may hold any number
        if not all(-10 < value < 10 for value in (x, y, u, v)):
            raise ValueError("pointer: expected a place near the canvas, found another")
        words = [message.get(name, "") for name in ("what", "on", "mode")]
        if not all(isinstance(word, str) for word in words):
            raise ValueError("pointer: expected words, found others")
        alt, shift = (bool(message.get(name)) for name in ("alt", "shift"))
        return Pointer(words[0], (x, y), words[1], words[2], alt, shift, (u, v))


class Panel:
    """One step of the workflow."""

    _held_box: tuple[Box, Corner] | None = None

    def __init__(self, editor: Editor) -> None:
        """Attach to an editor."""
        self.editor = editor

    @property
    def session(self) -> Session:
        """The open project; raises ValueError if no project is open."""
        return self.editor.require_session()

    def _sets(self, name: str) -> Callable[[Any], None]:
        """Return the handler of a control that sets a field of this panel."""
        return partial(setattr, self, name)

    def camera(self, view: View) -> Cameras:
        """Return the camera of a window's full picture; raise ValueError if it shows no scene."""
        orbit = self.editor.orbit(view)
        if orbit is None or not all(view.size):
            raise ValueError("view: expected a scene in view, found none")
        return orbit.camera(*view.canvas)

    def enter(self) -> None:
        """Set up the step when it is shown."""

    def leave(self) -> None:
        """Clean up when the step is left."""
        self._held_box = None

    def dragged_box(self, view: View, pointer: Pointer, box: Box | None) -> Box | None:
        """Return the box whose corner the pointer drags; None if it drags none."""
        held, is_lower = self._held_box, pointer.on == "lower"
        if pointer.what == "down" and box is not None:
            self._held_box = box, Corner(box.lower if is_lower else box.upper, self.camera(view))
        elif pointer.what != "move":
            self._held_box = None
        if held is None or pointer.what in ("down", "cancel"):
            return None
        corner, opposite = held[1].at(pointer.place), held[0].upper if is_lower else held[0].lower
        lower, upper = torch.minimum(corner, opposite), torch.maximum(corner, opposite)
        return Box(lower, torch.maximum(upper, lower + _SHORTEST * float((upper - lower).max()) + 1e-9))

    def surface_under(self, pointer: Pointer, view: View, scene: Gaussians) -> tuple[Float[Tensor, 3], Ray]:
        """Return the point of a scene's surface under the pointer, and the ray through it.

        Raises:
            ValueError: No surface is under the pointer.
        """
        ray = Ray.through(pointer.place, self.camera(view))
        hit = first_surface_hit(scene, ray.origin, ray.direction)
        if hit is None:
            raise ValueError("Click on a surface: there is none under the pointer.")
        return hit, ray

    def build(self, form: Form) -> None:
        """Add the controls for the current state."""
        raise NotImplementedError

    def tools(self) -> dict[str, Any]:
        """Return the tools for the canvas: `tools`, `paint`, `rectangle`."""
        return {}

    def picture(self, view: View, camera: Cameras) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
        """Draw a view, and return the picture and its caption."""
        return self.editor.draw_target(view, camera)

    def overlay(self, view: View, camera: Cameras) -> dict[str, Any]:
        """Describe the overlay: `hulls`, `lines` and `dots`."""
        return {}

    def pointer(self, view: View, pointer: Pointer) -> None:
        """Handle an action of the pointer."""

    def key(self, view: View, key: str) -> bool:
        """Handle a key; return whether this step uses it."""
        return False

    def uploaded(self, path: Path, use: str) -> None:
        """Use a file that was uploaded for a control."""

    def job_ended(self, job: JobState) -> None:
        """Update the step after a job has ended; called for all steps."""


def box_over(box: Box, camera: Cameras, color: str) -> dict[str, Any]:
    """Describe the edges of a box and its two corners as an overlay."""
    at = on_canvas(box.corners, camera)
    ends = on_canvas(torch.stack([box.lower, box.upper]), camera)
    return {
        "lines": [{"points": [at[i], at[j]], "color": color} for i, j in _BOX_EDGES if at[i] and at[j]],
        "dots": [{"at": p, "color": color, "id": n} for n, p in zip(CORNERS, ends, strict=True) if p],
    }
