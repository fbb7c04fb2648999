"""Pictures of the edited scene by splatgraft's renderer: pasted object, relit scene, result, and their layers."""

import threading
from dataclasses import dataclass, replace
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_upright
from splatgraft.editor.memo import Memo
from splatgraft.editor.photo_view import PhotoView, prompt_of
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
    "Selection",
    "Object alone",
]
PICTURE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind)[:6]
"""Kinds of pictures of the target."""
SOURCE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind)[6:]
"""Kinds of pictures of the source."""
TINT = (1.0, 0.45, 0.1)
"""sRGB color of what is selected."""
_LONGEST_PX = 1920
"""Longest side of a photo on the canvas, pixels; on a larger canvas the browser enlarges it."""
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

    def of_source(
        self, kind: PictureKind, state: EditState, which: Bool[Tensor, "n"] | None, camera: Cameras, photo: int | None
    ) -> Picture:
        """Render the source, or the Gaussians selected by `which` alone, or the source with them tinted.

        Where `photo` is the number of a photo of the capture, it stands in place of the rendered picture, as large as
        it fits, with what was clicked in it.
        """
        scene = self._scenes.gaussians(self._scenes.files.source_scene)
        if kind == "Object alone":
            return Picture(_bytes(render(scene if which is None else scene.select(which), camera).color[0]))
        flags = None if kind == "Source" or which is None else which[:, None].to(scene.means)
        if photo is None:
            found = render(scene, camera, features=flags)
            pixels = _bytes(found.color[0])
            return Picture(pixels if flags is None else _tinted(pixels, found.features[0, ..., 0]))
        capture = self._scenes.capture(self._scenes.files.source_cameras)
        pixels, size = self.photo(photo)
        view = PhotoView(size, (camera.width, camera.height))
        if flags is not None:
            width = view.drawn_size[0]
            posed = capture.cameras[photo].resized(width / capture.cameras[photo].width)
            share = render(scene, posed, outputs=frozenset(), features=flags).features[0, ..., 0].numpy()
            share = cv2.resize(share, (pixels.shape[1], pixels.shape[0]), interpolation=cv2.INTER_LINEAR)
            pixels = _tinted(pixels, torch.from_numpy(share))
        return Picture(view.drawn(pixels, prompt_of(state.prompts, capture.cameras.names[photo])))

    def photo(self, index: int) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[int, int]]:
        """A photo of the source, upright and at most 1920 pixels long, and its own width and height."""
        path = self._scenes.capture(self._scenes.files.source_cameras).image_paths[index]
        stamp = path.stat().st_mtime_ns if path.is_file() else 0
        return self._scenes.derive("photo", (str(path), stamp), lambda: read_upright(path, _LONGEST_PX))

    def without_object(self, state: EditState, index: int, camera: Cameras) -> Picture:
        """The target with all objects but one, pasted: what stays the same while that one is dragged."""
        objects = state.objects or ()
        rest = replace(state, objects=(*objects[:index], *objects[index + 1 :]))
        if not rest.objects:
            return self.view("Target alone", rest, camera)
        found = render(self._scenes.composite(rest).bake()[0], camera, outputs=frozenset({"color", "depth"}))
        depth = torch.where(found.alpha[0] > 0.5, found.depth[0], torch.inf)
        return Picture(_bytes(found.color[0]), depth.numpy())

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


def with_object(background: Picture, object_: Gaussians, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
    """A picture with an object in front of what is farther away in it."""
    found = render(object_, camera, outputs=frozenset({"color", "inverse_depth"}))
    alpha = found.alpha[0].numpy()
    if background.depth is not None:
        # the mean of inverse depth: faint pixels of the outline have no median depth
        is_nearer = found.inverse_depth[0].numpy() > alpha / background.depth
        alpha = np.where(is_nearer, alpha, 0)
    color = found.color[0].clamp(0, 1).numpy()
    share = np.where(alpha > 0, 1 - alpha, 1)[..., None]
    out = background.pixels * share + 255 * np.where(alpha[..., None] > 0, color, 0)
    return out.clip(0, 255).astype(np.uint8)


def _tinted(pixels: UInt8[np.ndarray, "h w 3"], share: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with a colour over what is selected, and a line around it."""
    inside = share.clamp(0, 1).numpy()[..., None]
    out = pixels * (1 - 0.4 * inside) + 0.4 * inside * 255 * np.array(TINT)
    out = np.ascontiguousarray(out.clip(0, 255).astype(np.uint8))
    edges = cv2.findContours((inside[..., 0] > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    r, g, b = (255 * value for value in TINT)
    cv2.drawContours(out, edges, -1, (r, g, b), max(2, pixels.shape[1] // 500), cv2.LINE_AA)
    return out


def jpeg(pixels: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    """A picture as JPEG, of a quality from 0 to 100."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), options)[1].tobytes()


def with_badge(pixels: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with a word in its lower left corner."""
    out = np.ascontiguousarray(pixels.copy())
    size = max(0.4, pixels.shape[1] / 2400)
    (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    x, y = round(12 * size) + 24, pixels.shape[0] - round(14 * size) - 4
    corner, end = (x - 6, y - height - 6), (x + width + 6, y + base + 2)
    patch = out[max(0, corner[1]) : end[1], max(0, corner[0]) : end[0]]
    patch[:] = patch // 3
    cv2.putText(out, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, (235, 235, 235), 1, cv2.LINE_AA)
    return out


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
