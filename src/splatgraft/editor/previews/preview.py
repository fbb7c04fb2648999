"""Preview images of the edited scene by splatgraft's renderer: composite, relit scene, result and their layers."""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.previews.level_of_detail import largest_coverage_indices
from splatgraft.editor.previews.preview_relighting import PreviewRelighting
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.scene_cache import SceneCache
from splatgraft.formats import read_capture
from splatgraft.rendering import render
from splatgraft.runtime.memo import Memo

PictureKind = Literal[
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
PICTURE_KINDS: tuple[PictureKind, ...] = (
    "Copy-paste",
    "Light transfer",
    "Result",
    "Target alone",
    "Mask",
    "Depth",
    "Shadow layer",
    "Photograph",
)
"""Kinds of images of the target; those of the source are `Source` and `Object alone`."""
_COLORED: tuple[PictureKind, ...] = ("Copy-paste", "Light transfer", "Result", "Target alone")
"""Kinds that are colours of a scene."""
NEEDS_LIGHT: tuple[PictureKind, ...] = ("Light transfer", "Shadow layer")
"""Kinds that need the light transfer."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered image with the depth of what it shows."""

    pixels: UInt8[np.ndarray, "h w 3"]
    """sRGB."""
    depth: Float[np.ndarray, "h w"] | None = None
    """Depth along the optical axis, world units; infinite where nothing is. None for images without depth."""


@dataclass(frozen=True)
class PictureSize:
    """Width of preview images, adapted so that rendering one takes about `seconds`."""

    width: int = 480
    """Pixels."""
    min_width: int = 160
    """Pixels."""
    max_width: int = 800
    """Pixels."""
    seconds: float = 0.3
    """Wanted rendering time of one image."""

    def adapted(self, seconds: float) -> int:
        """The width for the next image after one took `seconds`; time is proportional to area, and 20% is tolerated."""
        wanted = self.width * min(2.0, max(0.4, (self.seconds / max(seconds, 1e-3)) ** 0.5))
        wanted = min(self.max_width, max(self.min_width, round(wanted / 16) * 16))
        return self.width if abs(wanted - self.width) < 0.2 * self.width else wanted


class Preview:
    """Preview images of one project; intermediate results are memoised."""

    def __init__(self, scenes: SceneCache, relighting: PreviewRelighting) -> None:
        """Start with an empty memo."""
        self._scenes, self._relighting = scenes, relighting
        self._memo = Memo()
        self._lock = threading.RLock()

    def picture(
        self, kind: PictureKind, state: EditState, camera: Cameras, *, draft: bool = False
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Render one image.

        Args:
            kind: What the image shows.
            state: The edits.
            camera: One camera.
            draft: Use a draft of the light where the full light transfer is not available yet.

        Raises:
            ValueError: If a file that the image needs does not exist yet.
        """
        return self.view(kind, state, camera, draft=draft).pixels

    def view(
        self, kind: PictureKind, state: EditState, camera: Cameras, *, draft: bool = False, budget: int | None = None
    ) -> Picture:
        """Render one image with its depth.

        Args:
            kind: As for `picture`.
            state: As for `picture`.
            camera: As for `picture`.
            draft: As for `picture`.
            budget: Maximum number of Gaussians that are drawn of a coloured image; None: all.

        Raises:
            ValueError: As `picture`.
        """
        with self._lock:
            if kind not in _COLORED:
                return Picture(self._layer(kind, state, camera, draft=draft))
            scene = self._scene(kind, state, draft=draft)
            if budget is not None and scene.count > budget:
                scene = self._memo.get(
                    f"coarse {kind}", (scene, budget), lambda: scene.select(largest_coverage_indices(scene, budget))
                )
            return _drawn(scene, camera)

    def _layer(
        self, kind: PictureKind, state: EditState, camera: Cameras, *, draft: bool
    ) -> UInt8[np.ndarray, "h w 3"]:
        if kind == "Photograph":
            return self._photograph(camera)
        if kind in ("Mask", "Depth"):
            return self._mask(state, camera) if kind == "Mask" else self._depth(state, camera)
        return self._shadow(state, camera, draft=draft)

    def source_picture(self, which: Bool[Tensor, "n"] | None, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        """Render the source scene, or the Gaussians selected by `which`."""
        scene = self._scenes.gaussians(self._scenes.files.source_scene)
        color = render(scene if which is None else scene.select(which), camera).color
        return _bytes(color[0])

    def sampled_view(self, state: EditState, camera: Cameras, *, source: Path | None) -> Picture:
        """Render a sample of a scene, before the whole scene has been read.

        Args:
            state: The edits.
            camera: One camera.
            source: File of the source, where it is drawn; None: the target with its objects.

        Raises:
            ValueError: If a file is missing or invalid.
        """
        if source is None:
            scene = self._scenes.sampled_composite(state).bake()[0]
        else:
            scene = self._scenes.sampled_gaussians(source) or self._scenes.gaussians(source)
        return _drawn(scene, camera)

    def _scene(self, kind: PictureKind, state: EditState, *, draft: bool) -> Gaussians:
        if kind == "Result":
            if not self._scenes.files.result.is_file():
                raise ValueError("Result: expected a finished run, found none yet")
            return self._scenes.gaussians(self._scenes.files.result)
        if kind == "Light transfer":
            return self._relighting.scene(state, draft=draft)
        composite = self._relighting.composite(state)
        if kind == "Target alone":
            inputs = (composite.target, composite.erased)
            return self._memo.get("target alone", inputs, lambda: composite.target.select(~composite.erased))
        return self._relighting.pasted(composite)[0]

    def _mask(self, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        composite = self._relighting.composite(state)
        gaussians, is_object = self._relighting.pasted(composite)
        features = render(gaussians, camera, outputs=frozenset(), features=is_object[:, None].float()).features
        return _bytes(features[0].expand(-1, -1, 3))

    def _depth(self, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        composite = self._relighting.composite(state)
        gaussians, _ = self._relighting.pasted(composite)
        depth = render(gaussians, camera, outputs=frozenset({"depth"})).depth
        covered = depth[0][depth[0] > 0]
        if not len(covered):
            return _bytes(torch.zeros(*depth[0].shape, 3))
        # reciprocal depth between its 2nd and 98th percentile, so that floaters do not set the range
        inverse = 1 / depth[0].clamp_min(1e-6)
        low, high = 1 / float(covered.quantile(0.98)), 1 / float(covered.quantile(0.02))
        level = ((inverse - low) / max(high - low, 1e-9)).clamp(0, 1) * (depth[0] > 0)
        colored = cv2.applyColorMap((level * 255).byte().numpy(), cv2.COLORMAP_TURBO)
        return np.ascontiguousarray(colored[..., ::-1])

    def _shadow(self, state: EditState, camera: Cameras, *, draft: bool) -> UInt8[np.ndarray, "h w 3"]:
        if not self._scenes.files.transfers_light:
            raise ValueError(
                f"Shadow layer: expected the physical transfer, found {self._relighting.light_mode_note()}"
            )
        relighting = self._relighting
        relit = relighting.best_available(state) if draft else relighting.relit(state)
        layers = self._memo.get("layers", (relit, state.weights), lambda: relit.ratio(state.weights))
        # a ratio of 1 is mid grey, so that darkening and brightening both show
        rendered = render(relit.gaussians, camera, outputs=frozenset(), features=(0.5 * layers).clamp(0, 1))
        return _bytes(rendered.features[0] + 0.5 * (1 - rendered.alpha[0])[..., None])

    def _photograph(self, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        path = self._scenes.files.target_cameras
        stamp = path.stat().st_mtime_ns if path.is_file() else 0
        capture = self._memo.get("capture", (path, stamp), lambda: read_capture(self._scenes.files.target_capture))
        if camera.names[0] not in capture.cameras.names:
            raise ValueError("Photograph: expected one of the target's cameras, found a free view; step to a camera")
        image = capture.image(capture.cameras.names.index(camera.names[0]))
        return cv2.resize(_bytes(image), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def wipe_comparison(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], split: float
) -> UInt8[np.ndarray, "h w 3"]:
    """`left` up to fraction `split` of the width, `right` beyond it, and a white line between them."""
    width = left.shape[1]
    at = round(min(1.0, max(0.0, split)) * width)
    out = np.concatenate([left[:, :at], right[:, at:]], axis=1)
    if 0 < at < width:
        out[:, max(0, at - 1) : at + 1] = 255
    return out


def with_badge(pixels: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with a word in its lower left corner."""
    out = np.ascontiguousarray(pixels.copy())
    size = max(0.4, pixels.shape[1] / 2400)
    (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    x, y = round(12 * size) + 4, pixels.shape[0] - round(14 * size) - 4
    corner, end = (x - 6, y - height - 6), (x + width + 6, y + base + 2)
    patch = out[max(0, corner[1]) : end[1], max(0, corner[0]) : end[0]]
    patch[:] = patch // 3
    cv2.putText(out, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, (235, 235, 235), 1, cv2.LINE_AA)
    return out


def _drawn(scene: Gaussians, camera: Cameras) -> Picture:
    found = render(scene, camera, outputs=frozenset({"color", "depth"}))
    # where little is drawn, depth is that of haze
    depth = torch.where(found.alpha[0] > 0.5, found.depth[0], torch.inf)
    return Picture(_bytes(found.color[0]), depth.numpy())


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
