"""A brush over the picture: a click or a drag takes what it passes over. Knows nothing about what it is for."""

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
from splatgraft.editor.session.picking import Ray, between, painted

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_CANVAS, _STROKE = "/brush/canvas", "/source/stroke"


class Brush:
    """While it is on, the left button paints; what is touched shows at once, and is handed on when the stroke ends."""

    def __init__(self, page: Page, *, on_stroke: Callable[[Tensor], None], color: Callable[[], Color]) -> None:
        """Off."""
        self._page, self._on_stroke, self._color = page, on_stroke, color
        self._scene: Gaussians | None = None
        self._size = 0.1
        self._canvas: viser.IcosphereHandle | None = None
        self._rays: tuple[Ray, ...] = ()
        self._done, self._touched = 0, torch.zeros(0, dtype=torch.bool)
        self._latest = LatestOnlyWorker(self._paint, lambda error: page.say(" ".join(str(error).split()), bad=True))
        page.at_end.append(self._latest.close)

    def on(self, scene: Gaussians, *, size: float) -> None:
        """Paint on this scene from now on; `size` is the width of the brush over the distance of what it touches."""
        self._scene, self._size = scene, size
        if self._canvas is not None:
            return
        centre = scene.means.median(0).values
        # all around whatever the camera does: what is dragged is this sphere, seen from within and not drawn
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
        # a node that can be clicked would be outlined while the pointer is on it
        self._page.server.scene.on_click()(self._clicked)

    def off(self) -> None:
        """The left button turns the view again."""
        if self._canvas is not None:
            self._page.server.scene.remove_click_callback(self._clicked)
            self._canvas.remove()
            self._canvas = None

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._rays, self._done = (Ray(_vector(event.ray_origin), _vector(event.ray_direction)),), 0
        self._latest.ask(True)

    async def _dragged(self, event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
        origin = _vector(event.client.camera.position)
        if event.phase == "start":
            self._rays, self._done = (Ray(origin, _vector(event.start_position) - origin),), 0
        ray = Ray(origin, _vector(event.end_position) - origin)
        self._rays = (*self._rays, *between(self._rays[-1], ray, size=self._size))
        self._latest.ask(event.phase == "end")

    def _paint(self, ended: bool) -> None:
        scene, rays = self._scene, self._rays
        if scene is None:
            return
        if self._done == 0:
            self._touched = torch.zeros(scene.count, dtype=torch.bool)
        new, self._done = rays[self._done :], len(rays)
        touched = self._touched | painted(scene, new, size=self._size)
        changed = not torch.equal(touched, self._touched)
        self._touched = touched
        if ended:
            self._page.act(lambda _: self._hand_on(touched))(None)
        elif changed:
            self._page.view.splats(_STROKE, scene.select(touched), tint=self._color())

    def _hand_on(self, touched: Tensor) -> None:
        self._page.view.drop(_STROKE)
        if not bool(touched.any()):
            raise ValueError("brush: expected something solid under the stroke, found nothing")
        self._on_stroke(touched)


def _vector(values: object) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
