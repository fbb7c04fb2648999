"""True pictures of what is placed, by our own renderer: pasted, lit, finished, and what lies behind them.

Knows nothing about browsers.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.previews.transfers import Transfers
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.scene_cache import Scenes
from splatgraft.formats import read_capture
from splatgraft.rendering import render
from splatgraft.runtime.memo import Memo

Kind = Literal[
    "Copy-paste",
    "Light transfer",
    "Result",
    "Target alone",
    "Mask",
    "Depth",
    "Shadow layer",
    "Photograph",
    "Source",
    "Object alone",
]
KINDS: tuple[Kind, ...] = (
    "Copy-paste",
    "Light transfer",
    "Result",
    "Target alone",
    "Mask",
    "Depth",
    "Shadow layer",
    "Photograph",
)
"""What can be compared in the target; the source has `Source` and `Object alone`."""
NEEDS_LIGHT: tuple[Kind, ...] = ("Light transfer", "Shadow layer")


@dataclass(frozen=True)
class Size:
    """How large previews are made, so that one takes about as long as it may."""

    width: int = 480
    """Pixels."""
    least: int = 160
    """Pixels."""
    greatest: int = 800
    """Pixels."""
    seconds: float = 0.3
    """What one picture may take."""

    def after(self, seconds: float) -> int:
        """The width to take after a picture of `width` took `seconds`: time goes with the area; small changes wait."""
        wanted = self.width * min(2.0, max(0.4, (self.seconds / max(seconds, 1e-3)) ** 0.5))
        wanted = min(self.greatest, max(self.least, round(wanted / 16) * 16))
        return self.width if abs(wanted - self.width) < 0.2 * self.width else wanted


class Preview:
    """Pictures of one project, with what moving an object leaves unchanged kept."""

    def __init__(self, scenes: Scenes, transfers: Transfers) -> None:
        """Nothing made yet."""
        self._scenes, self._transfers = scenes, transfers
        self._kept = Memo()

    def picture(
        self, kind: Kind, state: EditState, camera: Cameras, *, draft: bool = False
    ) -> UInt8[np.ndarray, "h w 3"]:
        """One picture from one camera; with `draft` its light is the one that is there soonest.

        Raises: ValueError where what it shows is not there yet.
        """
        with self._transfers.work:
            return self._picture(kind, state, camera, draft=draft)

    def _picture(self, kind: Kind, state: EditState, camera: Cameras, *, draft: bool) -> UInt8[np.ndarray, "h w 3"]:
        if kind == "Photograph":
            return self._photograph(camera)
        if kind in ("Mask", "Depth"):
            return self._mask(state, camera) if kind == "Mask" else self._depth(state, camera)
        if kind == "Shadow layer":
            return self._shadow(state, camera, draft=draft)
        color = render(self._scene(kind, state, draft=draft), camera).color
        return _bytes(color[0])

    def source_picture(self, which: Bool[Tensor, "n"] | None, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        """The source scene, or those of its Gaussians that `which` names."""
        scene = self._scenes.gaussians(self._scenes.files.source_scene)
        color = render(scene if which is None else scene.select(which), camera).color
        return _bytes(color[0])

    def _scene(self, kind: Kind, state: EditState, *, draft: bool) -> Gaussians:
        if kind == "Result":
            if not self._scenes.files.result.is_file():
                raise ValueError("Result: expected a finished run, found none yet")
            return self._scenes.gaussians(self._scenes.files.result)
        if kind == "Light transfer":
            return self._transfers.scene(state, draft=draft)
        composite = self._transfers.composite(state)
        if kind == "Target alone":
            inputs = (composite.target, composite.erased)
            return self._kept.get("bare", inputs, lambda: composite.target.select(~composite.erased))
        return self._transfers.pasted(composite)[0]

    def _mask(self, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        composite = self._transfers.composite(state)
        gaussians, is_object = self._transfers.pasted(composite)
        features = render(gaussians, camera, outputs=frozenset(), features=is_object[:, None].float()).features
        return _bytes(features[0].expand(-1, -1, 3))

    def _depth(self, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        composite = self._transfers.composite(state)
        gaussians, _ = self._transfers.pasted(composite)
        depth = render(gaussians, camera, outputs=frozenset({"depth"})).depth
        near = depth[0][depth[0] > 0]
        if not len(near):
            return _bytes(torch.zeros(*depth[0].shape, 3))
        # of reciprocal depth, as eyes have it; the ends are of the picture, without its few stray Gaussians
        inverse = 1 / depth[0].clamp_min(1e-6)
        low, high = 1 / float(near.quantile(0.98)), 1 / float(near.quantile(0.02))
        level = ((inverse - low) / max(high - low, 1e-9)).clamp(0, 1) * (depth[0] > 0)
        colored = cv2.applyColorMap((level * 255).byte().numpy(), cv2.COLORMAP_TURBO)
        return np.ascontiguousarray(colored[..., ::-1])

    def _shadow(self, state: EditState, camera: Cameras, *, draft: bool) -> UInt8[np.ndarray, "h w 3"]:
        if not self._scenes.files.transfers_light:
            raise ValueError(f"Shadow layer: expected the physical transfer, found {self._transfers.note()}")
        transfers = self._transfers
        relit = transfers.soonest(state) if draft else transfers.relit(state)
        layers = self._kept.get("layers", (relit, state.weights), lambda: relit.ratio(state.weights))
        # half grey is unchanged, so that both what is darkened and what is brightened can be seen
        seen = render(relit.gaussians, camera, outputs=frozenset(), features=(0.5 * layers).clamp(0, 1))
        return _bytes(seen.features[0] + 0.5 * (1 - seen.alpha[0])[..., None])

    def _photograph(self, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        path = self._scenes.files.target_cameras
        stamp = path.stat().st_mtime_ns if path.is_file() else 0
        capture = self._kept.get("capture", (path, stamp), lambda: read_capture(self._scenes.files.target_capture))
        if camera.names[0] not in capture.cameras.names:
            raise ValueError("Photograph: expected one of the target's cameras, found a free view; step to a camera")
        image = capture.image(capture.cameras.names.index(camera.names[0]))
        return cv2.resize(_bytes(image), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def wiped(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], share: float
) -> UInt8[np.ndarray, "h w 3"]:
    """`left` up to `share` of the width and `right` beyond, with a line between them."""
    width = left.shape[1]
    at = round(min(1.0, max(0.0, share)) * width)
    out = np.concatenate([left[:, :at], right[:, at:]], axis=1)
    if 0 < at < width:
        out[:, max(0, at - 1) : at + 1] = 255
    return out


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
