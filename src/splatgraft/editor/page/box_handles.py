"""A box in the 3D view with two corners that can be dragged. Knows nothing about what it is for."""

from collections.abc import Callable

import numpy as np
import torch
import viser

from splatgraft.editor.page.scene_view import SceneView
from splatgraft.segmentation import Box

_LEAST = 1e-4
"""Of an edge over the largest one: a box that was dragged flat stays a box."""


class BoxHandles:
    """Edges and two corner gizmos."""

    def __init__(self, server: viser.ViserServer, view: SceneView, name: str, *, color: tuple[int, int, int]) -> None:
        """Nothing shown yet."""
        self._server, self._view, self._name, self._color = server, view, name, color
        self._box: Box | None = None
        self.on_moved: Callable[[Box, bool], None] = lambda box, ended: None

    @property
    def box(self) -> Box | None:
        """The box that is shown."""
        return self._box

    def show(self, box: Box) -> None:
        """Show this box."""
        new = self._box is None
        self._box = box
        self._view.box(f"{self._name}/edges", box, self._color)
        size = 0.35 * float((box.upper - box.lower).max())
        for corner, at in (("lower", box.lower), ("upper", box.upper)):
            handle = self._server.scene.get_handle_by_name(f"{self._name}/{corner}")
            if new or handle is None:
                handle = self._server.scene.add_transform_controls(
                    f"{self._name}/{corner}", scale=size, disable_rotations=True, position=at.numpy()
                )
                handle.on_update(self._dragged)
            else:
                handle.position = at.numpy()

    def hide(self) -> None:
        """Take it away."""
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
        least = _LEAST * float((upper - lower).max()) + 1e-9
        self._box = Box(lower, torch.maximum(upper, lower + least))
        self._view.box(f"{self._name}/edges", self._box, self._color)
        if event.phase != "start":
            self.on_moved(self._box, event.phase == "end")
