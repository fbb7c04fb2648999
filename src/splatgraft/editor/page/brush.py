"""A brush in the 3D view that selects Gaussians by clicks and drags."""

from collections.abc import Callable

import numpy as np
import torch
import viser
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.page.context import PageContext
from splatgraft.editor.page.scene_view import Color
from splatgraft.editor.picking import Ray, brush_selection, interpolate_rays
from splatgraft.editor.worker import LatestOnlyWorker

_CANVAS, _STROKE = "/brush/canvas", "/source/stroke"


class Brush:
    """While active, the left mouse button paints; the selection is shown during the stroke."""

    def __init__(
        self, context: PageContext, *, on_stroke: Callable[[Tensor], None], color: Callable[[], Color]
    ) -> None:
        """Start inactive.

        Args:
            context: The page's.
            on_stroke: Called with the selected Gaussians at the end of a stroke.
            color: Gives the colour in which the selection is shown.
        """
        self._context, self._on_stroke, self._color = context, on_stroke, color
        self._scene: Gaussians | None = None
        self._size = 0.1
        self._canvas: viser.IcosphereHandle | None = None
        self._rays: tuple[Ray, ...] = ()
        self._rays_done, self._selected = 0, torch.zeros(0, dtype=torch.bool)
        self._worker = LatestOnlyWorker(self._paint, context.say_error)
        context.on_close.append(self._worker.close)

    def activate(self, scene: Gaussians, *, size: float) -> None:
        """Paint on `scene`; `size` is the diameter of the brush over the distance of the hit point."""
        self._scene, self._size = scene, size
        if self._canvas is not None:
            return
        centre = scene.means.median(0).values
        # an invisible sphere around camera and scene receives the drags
        self._canvas = self._context.server.scene.add_icosphere(
            _CANVAS,
            radius=1000 * float((scene.means - centre).norm(dim=1).median()) + 1e-6,
            position=centre.numpy(),
            subdivisions=1,
            opacity=0.0,
            side="back",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._canvas.on_drag("left")(self._dragged)
        # clicks are taken from the scene: viser outlines a clickable node under the pointer
        self._context.server.scene.on_click()(self._clicked)

    def deactivate(self) -> None:
        """Stop painting; the left mouse button rotates the view again."""
        if self._canvas is not None:
            self._context.server.scene.remove_click_callback(self._clicked)
            self._canvas.remove()
            self._canvas = None

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._rays, self._rays_done = (Ray(_vector(event.ray_origin), _vector(event.ray_direction)),), 0
        self._worker.submit(True)

    async def _dragged(self, event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
        origin = _vector(event.client.camera.position)
        if event.phase == "start":
            self._rays, self._rays_done = (Ray(origin, _vector(event.start_position) - origin),), 0
        ray = Ray(origin, _vector(event.end_position) - origin)
        self._rays = (*self._rays, *interpolate_rays(self._rays[-1], ray, size=self._size))
        self._worker.submit(event.phase == "end")

    def _paint(self, ended: bool) -> None:
        scene, rays = self._scene, self._rays
        if scene is None:
            return
        if self._rays_done == 0:
            self._selected = torch.zeros(scene.count, dtype=torch.bool)
        new, self._rays_done = rays[self._rays_done :], len(rays)
        selected = self._selected | brush_selection(scene, new, size=self._size)
        changed = not torch.equal(selected, self._selected)
        self._selected = selected
        if ended:
            self._context.callback(lambda _: self._finish_stroke(selected))(None)
        elif changed:
            self._context.view.show_splats(_STROKE, scene.select(selected), tint=self._color())

    def _finish_stroke(self, selected: Tensor) -> None:
        self._context.view.remove_splats(_STROKE)
        if not bool(selected.any()):
            raise ValueError("brush: expected a surface under the stroke, found none")
        self._on_stroke(selected)


def _vector(values: object) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
