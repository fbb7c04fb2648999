"""The 3D part of the page: splats, boxes, arrows, cameras. Knows nothing about what they mean."""

from dataclasses import dataclass

import numpy as np
import torch
import viser
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import C0
from splatgraft.editor.previews.level_of_detail import shown_indices
from splatgraft.editor.session.gizmo import gizmo_of
from splatgraft.segmentation import Box

Color = tuple[float, float, float]
TINT: Color = (1.0, 0.45, 0.1)
_EDGES = np.array([[i, j] for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1])


@dataclass(frozen=True)
class Shown:
    """How many of a scene's Gaussians a browser was given."""

    count: int
    """Sent."""
    total: int
    """In the file."""


class SceneView:
    """Scene nodes by name; what is shown already is not sent again."""

    def __init__(self, server: viser.ViserServer, *, budget: int) -> None:
        """Nothing shown yet; `budget` is how many Gaussians a browser gets per scene."""
        self._scene = server.scene
        self._budget = budget
        self._splats: dict[str, tuple[tuple[object, ...], viser.GaussianSplatHandle | None, Shown]] = {}
        self._kept: dict[str, object] = {}
        self.shown: dict[str, Shown] = {}

    def splats(
        self,
        name: str,
        gaussians: Gaussians,
        *,
        which: Bool[Tensor, "n"] | None = None,
        tint: Color | None = None,
        move: Similarity | None = None,
    ) -> None:
        """Show the Gaussians (those in `which`), moved as a whole by `move`; a move alone sends no splats again."""
        key = (id(gaussians), id(which), tint)
        kept = self._splats.get(name)
        if kept is None or kept[0] != key:
            # what `key` names must live as long as the key, or its number could be given to another
            self._kept[name] = (gaussians, which)
            chosen = gaussians if which is None else gaussians.select(which)
            kept = (key, *self._add(name, chosen, tint))
            self._splats[name] = kept
        handle, self.shown[name] = kept[1], kept[2]
        if handle is not None:
            self._place(handle, move or Similarity.identity())
            handle.visible = True

    def hide(self, prefix: str) -> None:
        """Hide all splats whose name begins with `prefix`."""
        for name, (_, handle, _) in self._splats.items():
            if name.startswith(prefix) and handle is not None:
                handle.visible = False
                self.shown.pop(name, None)

    def drop(self, name: str) -> None:
        """Remove one node of splats."""
        _, handle, _ = self._splats.pop(name, (None, None, None))
        self.shown.pop(name, None)
        if handle is not None:
            handle.remove()

    def move(self, name: str, move: Similarity) -> None:
        """Move splats that are shown."""
        _, handle, _ = self._splats.get(name, (None, None, None))
        if handle is not None:
            self._place(handle, move)

    def box(self, name: str, box: Box, color: tuple[int, int, int]) -> None:
        """The edges of a box."""
        corners = box.corners.numpy()
        self._scene.add_line_segments(name, points=corners[_EDGES], colors=color)

    def remove(self, name: str) -> None:
        """Remove any other node; nothing where there is none."""
        if self._scene.get_handle_by_name(name) is not None:
            self._scene.remove_by_name(name)

    def cameras(self, cameras: Cameras | None, *, size: float) -> None:
        """Where the photographs were taken; None takes them away."""
        self.remove("/cameras")
        if cameras is None:
            return
        quaternions = quaternion_from_rotation(cameras.world_from_camera[:, :3, :3])
        for index, (camera, wxyz) in enumerate(zip(cameras, quaternions.numpy(), strict=True)):
            fov = 2 * float(torch.atan(camera.height / (2 * camera.intrinsics[0, 1, 1])))
            self._scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=fov,
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
    ) -> tuple[viser.GaussianSplatHandle | None, Shown]:
        shown = gaussians.select(shown_indices(gaussians, self._budget))
        if not shown.count:
            self.remove(name)
            return None, Shown(0, gaussians.count)
        # viser keeps covariances in half precision: sizes are brought to where that is exact, the node takes them back
        unit = float(shown.log_scales.median().exp()) * 10
        colors = (0.5 + C0 * shown.sh[:, 0]).clamp(0, 1)
        if tint is not None:
            colors = 0.45 * colors + 0.55 * torch.tensor(tint)
        covariances = (shown.covariances / unit**2).clamp(-6e4, 6e4)
        handle = self._scene.add_gaussian_splats(
            name,
            centers=(shown.means / unit).numpy(),
            covariances=covariances.numpy(),
            rgbs=colors.numpy(),
            opacities=shown.opacities[:, None].numpy(),
        )
        self._kept[f"{name} unit"] = unit
        return handle, Shown(shown.count, gaussians.count)

    def _place(self, handle: viser.GaussianSplatHandle, move: Similarity) -> None:
        unit = self._kept[f"{handle.name} unit"]
        assert isinstance(unit, float)
        gizmo = gizmo_of(move, torch.zeros(3))
        handle.position, handle.wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)
        handle.scale = gizmo.scale * unit


def view_of(camera: viser.CameraHandle, *, width: int, least_aspect: float = 0.0) -> Cameras:
    """A window's camera as one of ours, `width` pixels wide; a narrower one than `least_aspect` sees more aside."""
    aspect = max(least_aspect, camera.aspect if camera.aspect > 0 else 1.5)
    height = max(16, round(width / aspect))
    pose = torch.eye(4)
    pose[:3, :3] = viser_rotation(camera.wxyz)
    pose[:3, 3] = torch.tensor(np.asarray(camera.position), dtype=torch.float32)
    focal = height / (2 * np.tan(camera.fov / 2))
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float32)
    return Cameras(pose[None], intrinsics[None], torch.tensor([[width, height]]), ("window",))


def viser_rotation(wxyz: np.ndarray) -> Float[Tensor, "3 3"]:
    """The rotation of a quaternion as viser holds it."""
    return rotation_from_quaternion(torch.tensor(np.asarray(wxyz), dtype=torch.float32)[None])[0]
