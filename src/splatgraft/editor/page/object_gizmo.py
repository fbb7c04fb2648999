"""The handles of a placed object in the 3D view: move and rotate, and an arrow above it for its scale.

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
from splatgraft.editor.session import placement_operations
from splatgraft.editor.session.gizmo import (
    Gizmo,
    degrees_from_quaternion,
    gizmo_from_similarity,
    quaternion_from_degrees,
    similarity_from_gizmo,
)
from splatgraft.editor.session.placement_operations import PlaceableObject

SNAP_DEGREES = 15.0
"""Step of snapped angles."""
_GIZMO_PX, _SCALE_PX = 110.0, 55.0
"""Length of the arrows on the screen, pixels."""
_ABOVE = 1.25
"""Height of the handle for the scale over the object's."""
_LEAST_SHARE = 0.02
"""Smallest scale that one drag reaches, over that at its start."""


class ObjectGizmo:
    """Handles at one object; none until it is shown."""

    def __init__(self, server: viser.ViserServer, on_dragged: Callable[[Similarity, bool], None]) -> None:
        """Show nothing yet; `on_dragged` gets the dragged placement and whether the drag has ended."""
        self._scene, self._on_dragged = server.scene, on_dragged
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
        upwards = _x_towards(placed.rotation @ item.base.up)
        if self._move is None or self._scale is None:
            self._move = self._scene.add_transform_controls(
                "/gizmo",
                scale=_GIZMO_PX,
                fixed=True,
                depth_test=False,
                line_width=4.0,
                position=gizmo.position,
                wxyz=gizmo.wxyz,
            )
            # viser has no handle for a scale
            self._scale = self._scene.add_transform_controls(
                "/gizmo_scale",
                scale=_SCALE_PX,
                fixed=True,
                depth_test=False,
                active_axes=(True, False, False),
                disable_sliders=True,
                disable_rotations=True,
                position=top.numpy(),
                wxyz=upwards,
            )
            self._move.on_update(self._moved)
            self._scale.on_update(self._scaled)
            return
        self._move.position, self._move.wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)
        self._scale.position, self._scale.wxyz = top.numpy(), np.array(upwards)

    def remove(self) -> None:
        """Remove the handles; nothing where there are none."""
        for handle in (self._move, self._scale):
            if handle is not None:
                handle.remove()
        self._move = self._scale = self._shown = None

    async def _moved(self, event: viser.TransformControlsEvent) -> None:
        if self._shown is None or self._move is None or event.phase == "start":
            return
        item, placed = self._shown
        x, y, z = np.asarray(self._move.position).tolist()
        w, i, j, k = np.asarray(self._move.wxyz).tolist()
        wxyz = _snapped((w, i, j, k)) if self.snaps else (w, i, j, k)
        dragged = similarity_from_gizmo(Gizmo((x, y, z), wxyz, placed.scale), item.base.point)
        self._shown = (item, dragged)
        if self._scale is not None:
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
        scale = max(_LEAST_SHARE * self._scale_at_start, height / (_ABOVE * max(item.base.height, 1e-9)))
        dragged = placement_operations.rescale(item, placed, scale)
        self._shown = (item, replace(placed, scale=dragged.scale, translation=dragged.translation))
        self._on_dragged(dragged, event.phase == "end")


def _top(item: PlaceableObject, placed: Similarity) -> Float[Tensor, "3"]:
    """Where the handle for the scale stands: above the object, along its own up direction."""
    return placed.points(item.base.point + _ABOVE * max(item.base.height, 1e-9) * item.base.up)


def _x_towards(direction: Float[Tensor, "3"]) -> tuple[float, float, float, float]:
    """A rotation that turns x into a direction."""
    axis = torch.nn.functional.normalize(direction.float(), dim=0)
    w, x, y, z = quaternion_from_rotation(torch.stack([axis, *tangents(axis)], 1)[None])[0].tolist()
    return w, x, y, z


def _snapped(wxyz: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    return quaternion_from_degrees(placement_operations.snapped_angles(degrees_from_quaternion(wxyz), SNAP_DEGREES))
