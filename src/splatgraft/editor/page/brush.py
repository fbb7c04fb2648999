"""A brush in the 3D view that selects Gaussians by clicks and drags."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
import viser
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.page.scene_view import Color
from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker
from splatgraft.editor.session.picking import Ray, brush_selection, interpolate_rays

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_CANVAS, _STROKE = "/brush/canvas", "/source/stroke"


class Brush:
    """While active, the left mouse button paints; the selection is shown during the stroke."""

    def __init__(self, page: Page, *, on_stroke: Callable[[Tensor], None], color: Callable[[], Color]) -> None:
        """Start inactive.

        Args:
            page: The page.
            on_stroke: Called with the selected Gaussians at the end of a stroke.
            color: Gives the colour in which the selection is shown.
        """
        self._page, self._on_stroke, self._color = page, on_stroke, color
        self._scene: Gaussians | None = None
        self._size = 0.1
        self._canvas: viser.IcosphereHandle | None = None
        self._rays: tuple[Ray, ...] = ()
        self._rays_done, self._selected = 0, torch.zeros(0, dtype=torch.bool)
        self._worker = LatestOnlyWorker(self._paint, lambda error: page.say(" ".join(str(error).split()), bad=True))
        page.on_close.append(self._worker.close)

    def activate(self, scene: Gaussians, *, size: float) -> None:
        """Paint on `scene`; `size` is the diameter of the brush over the distance of the hit point."""
        self._scene, self._size = scene, size
        if self._canvas is not None:
            return
        centre = scene.means.median(0).values
        # an invisible sphere around camera and scene receives the drags
        self._canvas = self._page.server.scene.add_icosphere(
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
        self._page.server.scene.on_click()(self._clicked)

    def deactivate(self) -> None:
        """Stop painting; the left mouse button rotates the view again."""
        if self._canvas is not None:
            self._page.server.scene.remove_click_callback(self._clicked)
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
            self._page.callback(lambda _: self._finish_stroke(selected))(None)
        elif changed:
            self._page.view.show_splats(_STROKE, scene.select(selected), tint=self._color())

    def _finish_stroke(self, selected: Tensor) -> None:
        self._page.view.remove_splats(_STROKE)
        if not bool(selected.any()):
            raise ValueError("brush: expected a surface under the stroke, found none")
        self._on_stroke(selected)


def _vector(values: object) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
