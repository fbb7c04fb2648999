"""The picture behind the gizmos of one window, drawn by splatgraft's renderer in place of the window's splats."""

import threading

import cv2
import numpy as np
import viser
from jaxtyping import Float, UInt8
from viser import _messages

from splatgraft.editor.page.scene_view import SceneView

_JPEG_QUALITY = 90
_DEPTH_SHARE = 0.5
"""Resolution of the depth behind the gizmos over that of the picture."""


class Canvas:
    """Shows a picture with its depth in a window, or the splats again."""

    def __init__(self, server: viser.ViserServer, view: SceneView) -> None:
        """Show the splats of `view` in all windows of a server."""
        self._server, self._view = server, view
        self._window: viser.ClientHandle | None = None
        self._lock = threading.Lock()

    @property
    def is_shown(self) -> bool:
        """Whether a window shows a picture."""
        return self._window is not None

    def show(
        self,
        window: viser.ClientHandle,
        pixels: UInt8[np.ndarray, "h w 3"],
        depth: Float[np.ndarray, "y x"] | None,
    ) -> None:
        """Show a picture in place of the splats of one window.

        Args:
            window: The window.
            pixels: The picture, of the window's camera.
            depth: Depth along the optical axis, of any resolution, world units; None: gizmos are drawn over all.
        """
        with self._lock:
            if self._window is not None and self._window.client_id != window.client_id:
                self._show_splats()
            self._window = window
            with window.atomic():
                window.scene.set_background_image(pixels, format="jpeg", jpeg_quality=_JPEG_QUALITY, depth=depth)
                self._set_splats_visible(window, False)

    def clear(self) -> None:
        """Show the splats again."""
        with self._lock:
            self._show_splats()

    def _show_splats(self) -> None:
        window, self._window = self._window, None
        if window is not None and window.client_id in self._server.get_clients():
            with window.atomic():
                window.scene.set_background_image(None)
                self._set_splats_visible(window, True)

    def _set_splats_visible(self, window: viser.ClientHandle, visible: bool) -> None:
        # to this window alone: others show splats or pictures of their own
        for name in self._view.visible_splats():
            window._websock_connection.queue_message(_messages.SetSceneNodeVisibilityMessage(name, visible))


def depth_behind(depth: Float[np.ndarray, "h w"] | None) -> Float[np.ndarray, "y x"] | None:
    """A picture's depth as `Canvas.show` takes it, at half the resolution; viser stores up to 167 units."""
    if depth is None:
        return None
    size = (max(1, round(depth.shape[1] * _DEPTH_SHARE)), max(1, round(depth.shape[0] * _DEPTH_SHARE)))
    return cv2.resize(np.minimum(depth, 167.0), size, interpolation=cv2.INTER_NEAREST)
