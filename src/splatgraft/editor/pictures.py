"""Pictures of the edited scene by splatgraft's renderer: pasted object, relit scene, result, and their layers."""

import threading
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.memo import Memo
from splatgraft.editor.relit_preview import RelitPreview, largest_coverage_indices
from splatgraft.editor.scene_cache import SceneCache
from splatgraft.editor.state import EditState
from splatgraft.rendering import render

PictureKind = Literal[
    "Copy-paste",
    "Light transfer",
    "Result",
    "Target alone",
    "Shadow layer",
    "Photograph",
    "Source",
    "Object alone",
]
PICTURE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind)[:6]
"""Kinds of pictures of the target."""
SOURCE_KINDS: tuple[PictureKind, PictureKind] = ("Source", "Object alone")
"""Kinds of pictures of the source."""
NEEDS_LIGHT: tuple[PictureKind, ...] = ("Light transfer", "Shadow layer")
"""Kinds that need the light transfer."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered image with the depth of what it shows."""

    pixels: UInt8[np.ndarray, "h w 3"]
    """sRGB."""
    depth: Float[np.ndarray, "h w"] | None = None
    """Depth along the optical axis, world units; infinite where nothing is. None for images without depth."""


class Pictures:
    """Pictures of one project; intermediate results are memoised."""

    def __init__(self, scenes: SceneCache, relighting: RelitPreview) -> None:
        """Start with an empty memo."""
        self._scenes, self._relighting = scenes, relighting
        self._memo = Memo()
        self._lock = threading.RLock()

    def view(
        self, kind: PictureKind, state: EditState, camera: Cameras, *, draft: bool = False, budget: int | None = None
    ) -> Picture:
        """Render one picture of the target.

        A `draft` needs no full light transfer; of a coloured picture at most `budget` Gaussians are drawn.
        """
        with self._lock:
            if kind == "Photograph":
                return Picture(self._photograph(camera))
            if kind == "Shadow layer":
                return Picture(self._shadow(state, camera, draft=draft))
            scene = self._scene(kind, state, draft=draft)
            if budget is not None and scene.count > budget:
                scene = self._memo.get(
                    f"coarse {kind}", (scene,), lambda: scene.select(largest_coverage_indices(scene, budget))
                )
            found = render(scene, camera, outputs=frozenset({"color", "depth"}))
            # where little is drawn, depth is that of haze
            depth = torch.where(found.alpha[0] > 0.5, found.depth[0], torch.inf)
            return Picture(_bytes(found.color[0]), depth.numpy())

    def source_view(self, which: Bool[Tensor, "n"] | None, camera: Cameras) -> Picture:
        """Render the source scene, or the Gaussians selected by `which`."""
        scene = self._scenes.gaussians(self._scenes.files.source_scene)
        return Picture(_bytes(render(scene if which is None else scene.select(which), camera).color[0]))

    def _scene(self, kind: PictureKind, state: EditState, *, draft: bool) -> Gaussians:
        if kind == "Result":
            if not self._scenes.files.result.is_file():
                raise ValueError("Result: expected a finished run, found none yet")
            return self._scenes.gaussians(self._scenes.files.result)
        if kind == "Light transfer":
            return self._relighting.scene(state, draft=draft)
        composite = self._scenes.composite(state)
        if kind == "Target alone":
            inputs = (composite.target, composite.erased)
            return self._memo.get("target alone", inputs, lambda: composite.target.select(~composite.erased))
        return self._relighting.pasted(composite)[0]

    def _shadow(self, state: EditState, camera: Cameras, *, draft: bool) -> UInt8[np.ndarray, "h w 3"]:
        relighting = self._relighting
        if not self._scenes.files.transfers_light:
            raise ValueError(f"Shadow layer: expected the physical transfer, found {relighting.light_mode_note()}")
        relit = relighting.layers(state, draft=draft)
        layers = self._memo.get("layers", (relit, state.weights), lambda: relit.ratio(state.weights))
        # a ratio of 1 is mid grey, so that darkening and brightening both show
        rendered = render(relit.gaussians, camera, outputs=frozenset(), features=(0.5 * layers).clamp(0, 1))
        return _bytes(rendered.features[0] + 0.5 * (1 - rendered.alpha[0])[..., None])

    def _photograph(self, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        capture = self._scenes.capture(self._scenes.files.target_cameras)
        if camera.names[0] not in capture.cameras.names:
            raise ValueError("Photograph: expected one of the target's cameras, found a free view; step to a camera")
        image = capture.image(capture.cameras.names.index(camera.names[0]))
        return cv2.resize(_bytes(image), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def wipe_comparison(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], split: float
) -> UInt8[np.ndarray, "h w 3"]:
    """`left` up to fraction `split` of the width, `right` beyond it, and a white line between them."""
    width = left.shape[1]
    at = round(split * width)
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


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
