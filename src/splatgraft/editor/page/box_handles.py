"""An axis-aligned box in the 3D view with two draggable corners."""

from collections.abc import Callable

import numpy as np
import torch
import viser

from splatgraft.editor.page.scene_view import SceneView
from splatgraft.segmentation import Box

_HANDLE_PX = 60.0
"""Length of the handles' arrows on the screen, pixels."""
_MIN_EDGE = 1e-4
"""Shortest edge over the longest, so that a box that is dragged flat keeps a volume."""


class BoxHandles:
    """The edges of a box and a gizmo at its lower and upper corner."""

    def __init__(self, server: viser.ViserServer, view: SceneView, name: str, *, color: tuple[int, int, int]) -> None:
        """Show nothing yet; `name` is the path of the nodes in the 3D scene."""
        self._server, self._view, self._name, self._color = server, view, name, color
        self._box: Box | None = None
        self.on_dragged: Callable[[Box, bool], None] = lambda box, ended: None

    @property
    def box(self) -> Box | None:
        """The shown box; None where hidden."""
        return self._box

    def show(self, box: Box) -> None:
        """Show `box`."""
        is_new = self._box is None
        self._box = box
        self._view.show_box(f"{self._name}/edges", box, self._color)
        for corner, at in (("lower", box.lower), ("upper", box.upper)):
            handle = self._server.scene.get_handle_by_name(f"{self._name}/{corner}")
            if is_new or handle is None:
                handle = self._server.scene.add_transform_controls(
                    f"{self._name}/{corner}",
                    scale=_HANDLE_PX,
                    fixed=True,
                    depth_test=False,
                    disable_rotations=True,
                    position=at.numpy(),
                )
                handle.on_update(self._dragged)
            else:
                handle.position = at.numpy()

    def hide(self) -> None:
        """Remove the box."""
        self._box = None
        for part in ("edges", "lower", "upper"):
            self._view.remove(f"{self._name}/{part}")

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        if self._box is None:
            return
        ends = [self._server.scene.get_handle_by_name(f"{self._name}/{part}") for part in ("lower", "upper")]
        corners = torch.tensor(np.stack([np.asarray(end.position) for end in ends if end is not None])).float()
        if len(corners) < 2:
            return
        lower, upper = corners.amin(0), corners.amax(0)
        min_edge = _MIN_EDGE * float((upper - lower).max()) + 1e-9
        self._box = Box(lower, torch.maximum(upper, lower + min_edge))
        self._view.show_box(f"{self._name}/edges", self._box, self._color)
        if event.phase != "start":
            self.on_dragged(self._box, event.phase == "end")
