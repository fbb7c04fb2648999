"""Handles in the 3D view: a box with two draggable corners, and a placed object's gizmo with an arrow for its scale.

All are drawn over the scene and have a size on the screen, so that none is lost inside a large or small object.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.similarity import Similarity
from splatgraft.editor.page.scene_view import SceneView
from splatgraft.editor.placement import (
    Gizmo,
    PlaceableObject,
    degrees_from_quaternion,
    gizmo_from_similarity,
    quaternion_from_degrees,
    rescale,
    similarity_from_gizmo,
    snapped_angles,
)
from splatgraft.segmentation import Box

SNAP_DEGREES = 15.0
"""Step of snapped angles."""
_CORNER_PX, _GIZMO_PX, _SCALE_PX = 60.0, 110.0, 55.0
"""Length of the arrows on the screen, pixels."""
_MIN_EDGE = 1e-4
"""Shortest edge over the longest, so that a box that is dragged flat keeps a volume."""
_ABOVE = 1.25
"""Height of the handle for the scale over the object's."""
_MIN_SHARE = 0.02
"""Smallest scale that one drag reaches, over that at its start."""


def add_handle(
    server: viser.ViserServer, name: str, position: Float[Tensor, "3"], *, size_px: float
) -> viser.TransformControlsHandle:
    """A handle that moves a point."""
    return server.scene.add_transform_controls(
        name, scale=size_px, fixed=True, depth_test=False, disable_rotations=True, position=position.numpy()
    )


class BoxHandles:
    """The edges of a box and a handle at its lower and upper corner."""

    def __init__(
        self,
        server: viser.ViserServer,
        view: SceneView,
        name: str,
        *,
        color: tuple[int, int, int],
        on_dragged: Callable[[Box], None] = lambda box: None,
    ) -> None:
        """Show nothing yet; `on_dragged` gets the box at the end of a drag."""
        self._server, self._view, self._name, self._color = server, view, name, color
        self._on_dragged = on_dragged
        self.box: Box | None = None
        """The shown box; None where hidden."""

    def show(self, box: Box) -> None:
        """Show `box`."""
        self.box = box
        self._view.show_box(f"{self._name}/edges", box, self._color)
        for corner, at in (("lower", box.lower), ("upper", box.upper)):
            handle = self._server.scene.get_handle_by_name(f"{self._name}/{corner}")
            if handle is None:
                handle = add_handle(self._server, f"{self._name}/{corner}", at, size_px=_CORNER_PX)
                handle.on_update(self._dragged)
            else:
                handle.position = at.numpy()

    def hide(self) -> None:
        """Remove the box."""
        self.box = None
        for part in ("edges", "lower", "upper"):
            self._view.remove(f"{self._name}/{part}")

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        ends = [self._server.scene.get_handle_by_name(f"{self._name}/{part}") for part in ("lower", "upper")]
        corners = [torch.tensor(np.asarray(end.position)).float() for end in ends if end is not None]
        if self.box is None or len(corners) < 2:
            return
        lower, upper = torch.minimum(*corners), torch.maximum(*corners)
        min_edge = _MIN_EDGE * float((upper - lower).max()) + 1e-9
        self.box = Box(lower, torch.maximum(upper, lower + min_edge))
        self._view.show_box(f"{self._name}/edges", self.box, self._color)
        if event.phase == "end":
            self._on_dragged(self.box)


class ObjectGizmo:
    """Handles at one object; none until it is shown."""

    def __init__(self, server: viser.ViserServer, on_dragged: Callable[[Similarity, bool], None]) -> None:
        """Show nothing yet; `on_dragged` gets the dragged placement and whether the drag has ended."""
        self._server, self._on_dragged = server, on_dragged
        self._move: viser.TransformControlsHandle | None = None
        self._scale: viser.TransformControlsHandle | None = None
        self._shown: tuple[PlaceableObject, Similarity] | None = None
        self._scale_at_start = 1.0
        self.snaps = False
        """Whether angles are rounded."""

    def show(self, item: PlaceableObject, placed: Similarity) -> None:
        """Show the handles of an object at its placement, or move them there."""
        self._shown = (item, placed)
        gizmo, top = gizmo_from_similarity(placed, item.base.point), _top(item, placed)
        if self._move is None or self._scale is None:
            scene = self._server.scene
            self._move = scene.add_transform_controls(
                "/gizmo", scale=_GIZMO_PX, fixed=True, depth_test=False, line_width=4.0
            )
            # viser has no handle for a scale
            self._scale = scene.add_transform_controls(
                "/gizmo_scale",
                scale=_SCALE_PX,
                fixed=True,
                depth_test=False,
                active_axes=(True, False, False),
                disable_sliders=True,
                disable_rotations=True,
            )
            self._move.on_update(self._moved)
            self._scale.on_update(self._scaled)
        self._move.position, self._move.wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)
        self._scale.position, self._scale.wxyz = top.numpy(), _x_towards(placed.rotation @ item.base.up)

    def remove(self) -> None:
        """Remove the handles; nothing where there are none."""
        for handle in (self._move, self._scale):
            if handle is not None:
                handle.remove()
        self._move = self._scale = self._shown = None

    async def _moved(self, event: viser.TransformControlsEvent) -> None:
        if self._shown is None or self._move is None or self._scale is None or event.phase == "start":
            return
        item, placed = self._shown
        x, y, z = np.asarray(self._move.position).tolist()
        w, i, j, k = np.asarray(self._move.wxyz).tolist()
        if self.snaps:
            angles = snapped_angles(degrees_from_quaternion((w, i, j, k)), SNAP_DEGREES)
            w, i, j, k = quaternion_from_degrees(angles)
        dragged = similarity_from_gizmo(Gizmo((x, y, z), (w, i, j, k), placed.scale), item.base.point)
        self._shown = (item, dragged)
        self._scale.position = _top(item, dragged).numpy()
        self._on_dragged(dragged, event.phase == "end")

    async def _scaled(self, event: viser.TransformControlsEvent) -> None:
        if self._shown is None or self._scale is None:
            return
        item, placed = self._shown
        if event.phase == "start":
            self._scale_at_start = placed.scale
            return
        foot, up = placed.points(item.base.point), placed.rotation @ item.base.up
        height = float((torch.tensor(np.asarray(self._scale.position)).float() - foot) @ up)
        # dragged below its foot, the object keeps a size that can be seen and dragged again
        scale = max(_MIN_SHARE * self._scale_at_start, height / (_ABOVE * max(item.base.height, 1e-9)))
        dragged = rescale(item, placed, scale)
        self._shown = (item, replace(placed, scale=dragged.scale, translation=dragged.translation))
        self._on_dragged(dragged, event.phase == "end")


def _top(item: PlaceableObject, placed: Similarity) -> Float[Tensor, "3"]:
    """Where the handle for the scale stands: above the object, along its own up direction."""
    return placed.points(item.base.point + _ABOVE * max(item.base.height, 1e-9) * item.base.up)


def _x_towards(direction: Float[Tensor, "3"]) -> Float[np.ndarray, "4"]:
    """The quaternion of a rotation that turns x into a direction."""
    axis = torch.nn.functional.normalize(direction.float(), dim=0)
    return quaternion_from_rotation(torch.stack([axis, *tangents(axis)], 1)[None])[0].numpy()
