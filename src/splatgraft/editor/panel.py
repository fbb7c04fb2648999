"""What all steps of the editor have in common: a panel, a picture, what lies over it, and what the pointer does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import UInt8

from splatgraft.core.cameras import Cameras
from splatgraft.editor.drag import Corner, on_canvas
from splatgraft.editor.form import Form
from splatgraft.editor.jobs import JobState
from splatgraft.editor.picking import Ray
from splatgraft.editor.stream import View
from splatgraft.segmentation import Box

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

CORNERS = ("lower", "upper")
"""Names of the dots by which a box is dragged."""
_SHORTEST = 1e-4  # of a dragged box's edges over the longest, so that it keeps a volume
_BOX_EDGES = [(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1]


@dataclass(frozen=True)
class Pointer:
    """What the pointer did on the canvas."""

    what: str
    """down, move, up, cancel, click, or rectangle."""
    x: float
    """Place over the canvas's width."""
    y: float
    """Place over its height."""
    on: str = ""
    """What it held at the start: an object or a dot by its name, or nothing."""
    mode: str = "move"
    """How an object is dragged."""
    alt: bool = False
    """Whether Alt or the right button was held."""
    shift: bool = False
    """Whether Shift was held."""
    to: tuple[float, float] = (0.0, 0.0)
    """The other corner of a rectangle."""

    @staticmethod
    def of(message: dict[str, Any]) -> Pointer:
        """Check what a browser sent; ValueError, KeyError or TypeError where no page sends it."""
        x, y, u, v = (float(message.get(name, 0.0)) for name in ("x", "y", "u", "v"))
        # a pointer may leave the canvas, and no number is too large for a message
        if not all(-10 < value < 10 for value in (x, y, u, v)):
            raise ValueError("pointer: expected a place near the canvas, found another")
        words = [message.get(name, "") for name in ("what", "on", "mode")]
        if not all(isinstance(word, str) for word in words):
            raise ValueError("pointer: expected words, found others")
        return Pointer(words[0], x, y, words[1], words[2], bool(message.get("alt")), bool(message.get("shift")), (u, v))

    @property
    def place(self) -> tuple[float, float]:
        """Where it is, over the canvas's sides."""
        return self.x, self.y

    def ray(self, camera: Cameras) -> Ray:
        """The ray through it."""
        k, pose = camera.intrinsics[0], camera.world_from_camera[0]
        pixel = torch.tensor([self.x * camera.width, self.y * camera.height, 1.0])
        return Ray(pose[:3, 3], pose[:3, :3] @ (torch.linalg.inv(k) @ pixel))


class Panel:
    """One step of the workflow."""

    def __init__(self, editor: Editor) -> None:
        """Belong to an editor."""
        self.editor = editor

    def enter(self) -> None:
        """Begin what holds while the step is shown."""

    def leave(self) -> None:
        """End it."""

    def close(self) -> None:
        """End all threads."""

    def build(self, form: Form) -> None:
        """Describe the controls for the present state."""
        raise NotImplementedError

    def tools(self) -> dict[str, Any]:
        """What the page offers on the canvas: `tools`, `paint`, `rectangle`."""
        return {}

    def picture(self, view: View, camera: Cameras) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
        """The picture of a view, and its caption."""
        return self.editor.draw_target(view, camera)

    def overlay(self, view: View, camera: Cameras) -> dict[str, Any]:
        """What the page draws over it: `hulls`, `lines` and `dots`."""
        return {}

    def pointer(self, view: View, pointer: Pointer) -> None:
        """Take what the pointer did."""

    def key(self, view: View, key: str) -> bool:
        """Take a key; whether it has a meaning here."""
        return False

    def live(self, name: str, value: Any) -> None:
        """Show a value of a slider while it is dragged."""

    def uploaded(self, path: Path, use: str) -> None:
        """Use a file that was uploaded for a control."""

    def job_ended(self, job: JobState) -> None:
        """Update what depends on a job that has ended; called for all steps."""


def view_camera(editor: Editor, view: View) -> Cameras:
    """The camera of a window's full picture."""
    orbit = editor.orbit(view)
    if orbit is None or not all(view.size):
        raise ValueError("view: expected a scene in view, found none")
    return orbit.camera(*view.canvas)


class BoxDrag:
    """A box of which the pointer drags a corner, `lower` or `upper`, at its depth in a view."""

    def __init__(self, box: Box, corner: str, camera: Cameras) -> None:
        """Grab a corner."""
        self._box, self._is_lower = box, corner == "lower"
        self._corner = Corner(box.lower if self._is_lower else box.upper, camera)

    def at(self, place: tuple[float, float]) -> Box:
        """The box with the corner under the pointer."""
        corner = self._corner.at(place)
        ends = (corner, self._box.upper) if self._is_lower else (self._box.lower, corner)
        lower, upper = torch.minimum(*ends), torch.maximum(*ends)
        return Box(lower, torch.maximum(upper, lower + _SHORTEST * float((upper - lower).max()) + 1e-9))


def box_over(box: Box, camera: Cameras, color: str) -> dict[str, Any]:
    """The edges of a box and its two corners, over a picture."""
    at = on_canvas(box.corners, camera)
    ends = on_canvas(torch.stack([box.lower, box.upper]), camera)
    return {
        "lines": [{"points": [at[i], at[j]], "color": color} for i, j in _BOX_EDGES if at[i] and at[j]],
        "dots": [{"at": p, "color": color, "id": n} for n, p in zip(CORNERS, ends, strict=True) if p],
    }
