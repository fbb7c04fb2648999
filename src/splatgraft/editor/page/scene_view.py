"""The 3D view: Gaussian splats, boxes and cameras as viser scene nodes, and pictures in place of the splats."""

import threading
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import viser
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from viser import _messages

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import C0
from splatgraft.editor.memo import same_inputs
from splatgraft.editor.page.opening import COARSE_NODE, add_coarse
from splatgraft.editor.picking import Ray
from splatgraft.editor.placement import gizmo_from_similarity
from splatgraft.editor.relit_preview import largest_coverage_indices
from splatgraft.editor.scene_sample import SceneSample
from splatgraft.segmentation import Box

Color = tuple[float, float, float]
_EDGES = np.array([[i, j] for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1])
_JPEG_QUALITY = 90
_DEPTH_SHARE = 0.5
"""Resolution of the depth behind the gizmos over that of the picture."""
_SORT_SECONDS = 2.0
"""How long a picture stays behind the splats that take its place."""
_MAX_DEPTH = 167.0
"""World units; viser stores no more."""


@dataclass(frozen=True)
class ShownCount:
    """How many of a scene's Gaussians are shown."""

    count: int
    """Gaussians sent to the browser."""
    total: int
    """Gaussians in the file."""


class SceneView:
    """Scene nodes by name; unchanged splats are not sent again."""

    def __init__(self, server: viser.ViserServer, *, budget: int, coarse: Path | None = None) -> None:
        """Show at most `budget` Gaussians per node; of the scene `coarse` a sample is shown already."""
        self._server, self._scene, self._budget, self._coarse = server, server.scene, budget, coarse
        self._splats: dict[str, tuple[tuple[object, ...], viser.GaussianSplatHandle | None, ShownCount]] = {}
        self._units: dict[str, float] = {}
        self.shown: dict[str, ShownCount] = {}
        """The nodes of splats that are shown."""

    def show_coarse(self, scene: Path, sample: SceneSample | None) -> None:
        """Show a sample of a scene until `remove_coarse`; None shows what was shown before."""
        if scene != self._coarse and sample is not None:
            add_coarse(self._server, sample)
            self._coarse = scene

    def keep_coarse(self, scene: Path | None) -> None:
        """Remove the sample unless it is of this scene."""
        if scene != self._coarse:
            self.remove_coarse()

    def remove_coarse(self) -> None:
        """Remove the sample; nothing where there is none."""
        if self._coarse is not None:
            self.remove(COARSE_NODE)
            self._coarse = None

    def show_splats(
        self,
        name: str,
        gaussians: Gaussians,
        *,
        which: Bool[Tensor, "n"] | None = None,
        tint: Color | None = None,
        transform: Similarity | None = None,
    ) -> None:
        """Show a node of splats, of the Gaussians of a scene that `which` selects; None: of all.

        A change of `transform`, the world from the scene's frame, sends no splats again.
        """
        key = (gaussians, which, tint)
        known = self._splats.get(name)
        if known is None or not same_inputs(known[0], key):
            chosen = gaussians if which is None else gaussians.select(which)
            known = (key, *self._add(name, chosen, tint))
            self._splats[name] = known
        handle, self.shown[name] = known[1], known[2]
        if handle is not None:
            self._place(handle, transform or Similarity.identity())
            handle.visible = True

    def hide_splats(self, prefix: str) -> None:
        """Hide all splats whose name begins with `prefix`."""
        for name, (_, handle, _) in self._splats.items():
            if name.startswith(prefix) and handle is not None:
                handle.visible = False
                self.shown.pop(name, None)

    def visible_splats(self) -> tuple[str, ...]:
        """Names of the nodes of splats that are shown."""
        return (*filter(self.is_shown, self._splats), *(() if self._coarse is None else (COARSE_NODE,)))

    def is_shown(self, name: str) -> bool:
        """Whether a node of splats is shown."""
        _, handle, _ = self._splats.get(name, (None, None, None))
        return handle is not None and bool(handle.visible)

    def remove_splats(self, name: str) -> None:
        """Remove one node of splats."""
        _, handle, _ = self._splats.pop(name, (None, None, None))
        self.shown.pop(name, None)
        if handle is not None:
            handle.remove()

    def set_transform(self, name: str, transform: Similarity) -> None:
        """Move splats that are shown."""
        _, handle, _ = self._splats.get(name, (None, None, None))
        if handle is not None:
            self._place(handle, transform)

    def show_box(self, name: str, box: Box, color: tuple[int, int, int]) -> None:
        """The edges of a box."""
        self._scene.add_line_segments(name, points=box.corners.numpy()[_EDGES], colors=color)

    def remove(self, name: str) -> None:
        """Remove any other node; nothing where there is none."""
        if self._scene.get_handle_by_name(name) is not None:
            self._scene.remove_by_name(name)

    def show_cameras(self, cameras: Cameras | None, *, size: float) -> None:
        """Show camera frusta of that size in world units; None removes them."""
        self.remove("/cameras")
        if cameras is None:
            return
        quaternions = quaternion_from_rotation(cameras.world_from_camera[:, :3, :3])
        for index, (camera, wxyz) in enumerate(zip(cameras, quaternions.numpy(), strict=True)):
            self._scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=2 * float(torch.atan(camera.height / (2 * camera.intrinsics[0, 1, 1]))),
                aspect=camera.width / camera.height,
                scale=size,
                color=(90, 140, 200),
                wxyz=wxyz,
                position=camera.centers[0].numpy(),
                cast_shadow=False,
                receive_shadow=False,
            )

    def _add(
        self, name: str, gaussians: Gaussians, tint: Color | None
    ) -> tuple[viser.GaussianSplatHandle | None, ShownCount]:
        shown = gaussians.select(largest_coverage_indices(gaussians, self._budget))
        if not shown.count:
            self.remove(name)
            return None, ShownCount(0, gaussians.count)
        # viser stores covariances in half precision: the scene is scaled so that their range fits, the node scales back
        unit = float(shown.log_scales.median().exp()) * 10
        colors = (0.5 + C0 * shown.sh[:, 0]).clamp(0, 1)
        if tint is not None:
            colors = 0.45 * colors + 0.55 * torch.tensor(tint)
        handle = self._scene.add_gaussian_splats(
            name,
            centers=(shown.means / unit).numpy(),
            covariances=(shown.covariances / unit**2).clamp(-6e4, 6e4).numpy(),
            rgbs=colors.numpy(),
            opacities=shown.opacities[:, None].numpy(),
        )
        self._units[name] = unit
        return handle, ShownCount(shown.count, gaussians.count)

    def _place(self, handle: viser.GaussianSplatHandle, transform: Similarity) -> None:
        unit = self._units[handle.name]
        gizmo = gizmo_from_similarity(transform, torch.zeros(3))
        handle.position, handle.wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)
        handle.scale = gizmo.scale * unit


class Canvas:
    """Shows a picture with its depth in one window, behind the gizmos, or the splats again."""

    def __init__(self, server: viser.ViserServer, view: SceneView) -> None:
        """Show the splats of `view` in all windows of a server."""
        self._server, self._view = server, view
        self._window: viser.ClientHandle | None = None
        self._pixels: UInt8[np.ndarray, "h w 3"] | None = None
        """The picture that was shown last."""
        self._lock = threading.Lock()

    @property
    def is_shown(self) -> bool:
        """Whether a window shows a picture."""
        return self._window is not None

    def show(
        self, window: viser.ClientHandle, pixels: UInt8[np.ndarray, "h w 3"], depth: Float[np.ndarray, "h w"] | None
    ) -> None:
        """Show a picture of its camera in place of the splats of one window; without `depth` gizmos are over all."""
        if depth is not None:
            size = (max(1, round(depth.shape[1] * _DEPTH_SHARE)), max(1, round(depth.shape[0] * _DEPTH_SHARE)))
            depth = cv2.resize(np.minimum(depth, _MAX_DEPTH), size, interpolation=cv2.INTER_NEAREST)
        with self._lock:
            if self._window is not None and self._window.client_id != window.client_id:
                self._show_splats()
            self._window, self._pixels = window, pixels
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
                # the browser sorts the splats before it draws them: until then the picture stays, behind them
                if self._pixels is not None:
                    small = np.ascontiguousarray(self._pixels[::2, ::2])
                    window.scene.set_background_image(small, format="jpeg", jpeg_quality=_JPEG_QUALITY)
                self._set_splats_visible(window, True)
            threading.Timer(_SORT_SECONDS, self._remove_picture, (window,)).start()

    def _remove_picture(self, window: viser.ClientHandle) -> None:
        with self._lock:
            if self._window is None and window.client_id in self._server.get_clients():
                window.scene.set_background_image(None)

    def _set_splats_visible(self, window: viser.ClientHandle, visible: bool) -> None:
        # to this window alone: others show splats
        for name in self._view.visible_splats():
            window._websock_connection.queue_message(_messages.SetSceneNodeVisibilityMessage(name, visible))


def camera_from_viser(camera: viser.CameraHandle, *, width: int) -> Cameras:
    """The camera of a window, `width` pixels wide."""
    aspect = camera.aspect if camera.aspect > 0 else 1.5
    height = max(16, round(width / aspect))
    pose = torch.eye(4)
    pose[:3, :3] = rotation_from_quaternion(torch.tensor(np.asarray(camera.wxyz), dtype=torch.float32)[None])[0]
    pose[:3, 3] = torch.tensor(np.asarray(camera.position), dtype=torch.float32)
    focal = height / (2 * np.tan(camera.fov / 2))
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float32)
    return Cameras(pose[None], intrinsics[None], torch.tensor([[width, height]]), ("window",))


def direction_from_viser(camera: viser.CameraHandle) -> Float[Tensor, "3"]:
    """Where a window looks, unit, world frame."""
    wxyz = torch.tensor(np.asarray(camera.wxyz), dtype=torch.float32)
    return rotation_from_quaternion(wxyz[None])[0, :, 2]


def ray_from_viser(event: viser.SceneClickEvent) -> Ray:
    """The ray through a click."""
    assert event.ray_origin is not None
    assert event.ray_direction is not None
    return Ray(torch.tensor(event.ray_origin).float(), torch.tensor(event.ray_direction).float())
