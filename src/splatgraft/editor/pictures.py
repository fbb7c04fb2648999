"""Pictures of the edited scene by splatgraft's renderer, lit by the newest available layers.

An object that was moved since then keeps its last lit colours, over a contact shadow of its footprint.
"""

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.compositing.contact import SHAPE, flattened_under
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import read_upright, resize
from splatgraft.core.prompts import ViewPrompt
from splatgraft.core.similarity import Similarity
from splatgraft.editor.light_process import Stage
from splatgraft.editor.photo_view import PhotoView, prompt_of
from splatgraft.editor.relit_preview import Draft
from splatgraft.editor.scene_cache import SceneCache
from splatgraft.editor.state import EditState, stamp_of
from splatgraft.project.gaussian_flags import read_flags
from splatgraft.project.layout import IS_OBJECT_FILE
from splatgraft.project.placement import ObjectPlacement, object_to_json
from splatgraft.relighting import LayerWeights, Relit
from splatgraft.relighting.shading import apply_gain
from splatgraft.rendering import RenderOptions, render, view_operator
from splatgraft.runtime.memo import Memo
from splatgraft.segmentation import CUT_SIDE_PX, grabcut_mask, seed_selection

Kind = Literal["lit", "pasted", "result", "place"]
TINT = (1.0, 0.45, 0.1)
"""sRGB colour of the selection."""
_RANKS = {"draft": 0, "file": 1, "final": 1}  # of stages of the light; a later one is better
_LONGEST_PX = 1920  # longer side of a photo; the browser enlarges it on a larger canvas
_DARKEST = 0.5  # largest share of the light that a contact shadow removes
_SHADOW_WIDTH = 0.35  # width of a contact shadow over the object's radius
_NO_TURN = 1e-5  # largest deviation of a rotation from the identity by rounding
_NO_ROWS = torch.zeros(0, dtype=torch.int64)
_FOOT_SHARE, _FOOT_POINTS = 0.2, 200  # part of an object's height that counts as its foot; number of its points


@dataclass(frozen=True, eq=False)
class _LitState:
    """The lit scene of one state, in its current stage."""

    state: EditState
    stage: str
    """Stage of the light: `final` or `draft`; `file`: the step's result, without layers."""
    bake: Callable[[LayerWeights], tuple[Gaussians, Bool[Tensor, "b"]]]
    """The scene by the weights of its layers, with flags of the objects."""
    relit: Relit | None = None

    def fits(self, state: EditState) -> bool:
        """Return whether a state has the same light and placements."""
        return self.state.light is state.light and self.stands_as(state)

    def stands_as(self, state: EditState) -> bool:
        return self.state.erased is state.erased and same_places(self.state.objects, state.objects)


def same_places(a: Sequence[ObjectPlacement] | None, b: Sequence[ObjectPlacement] | None) -> bool:
    """Return whether objects and placements are the same, by the numbers that are written."""
    first, second = ([object_to_json(item, Path()) for item in items or ()] for items in (a, b))
    return first == second


class LitScenes:
    """The newest lit scene, from the light process or the step's files."""

    def __init__(self, scenes: SceneCache) -> None:
        """Start without a lit scene."""
        self._scenes, self._memo, self._lock = scenes, Memo(), threading.RLock()
        self._now: _LitState | None = None
        self._joined: _JoinedScene | None = None

    def add(self, state: EditState, stage: Stage, layers: Relit | Draft) -> None:
        """Store layers of the light process unless better ones are known."""
        with self._lock:
            now = self._now
            if now is not None and now.fits(state) and _RANKS[stage] < _RANKS[now.stage]:
                return
            relit = layers.of_all(self._scenes.composite(state)) if isinstance(layers, Draft) else layers
            self._now = _LitState(state, stage, relit.bake, relit)

    def adopt(self, state: EditState) -> None:
        """Read the result of the step `relight`, which is up to date for a state."""
        path = self._scenes.files.relit
        flags = read_flags(path.with_name(IS_OBJECT_FILE))
        scene = self._scenes.gaussians(path)
        with self._lock:
            self._now = _LitState(state, "file", lambda weights: (scene, flags))

    def stage(self, state: EditState) -> str:
        """Return the stage of a state's light; empty if it is not known."""
        now = self._now
        if now is None or not now.fits(state):
            return ""
        return "draft" if now.stage == "file" and now.state.weights != state.weights else now.stage

    def relit(self, state: EditState) -> Relit | None:
        """Return the layers of a state; None if they are not known yet."""
        now = self._now
        return now.relit if now is not None and now.fits(state) else None

    def scene(self, state: EditState) -> Gaussians:
        """Return a state's scene with the newest colours; after a move it is valid until the next call."""
        now = self._now
        if not self._scenes.files.transfers_light or not state.objects:
            return self.pasted(state)
        if now is not None and now.stands_as(state):
            return self._baked(now, state.weights)[0]
        inputs = (now, self.place(state), state.objects, state.weights)
        return self._memo.get("moved", inputs, lambda: self._moved(now, state))

    def pasted(self, state: EditState) -> Gaussians:
        """Return the scene that the step `compose` writes."""
        composite = self._scenes.composite(state)
        return self._memo.get("pasted", (composite,), composite.bake)[0]

    def place(self, state: EditState) -> Gaussians:
        """Return the target without erased Gaussians."""
        target, erased = self._scenes.scene("target"), state.erased
        if erased is None:
            return target
        if len(erased) != target.count:
            raise ValueError(
                f"erased.npy: expected one flag per Gaussian of the target, {target.count:,}; found {len(erased):,}; "
                "restore all erased, or undo"
            )
        return self._memo.get("place", (target, erased), lambda: target.select(~erased))

    def forget(self) -> None:
        """Discard the lit scene, because files or options have changed."""
        with self._lock:
            self._now = None

    def _baked(self, lit: _LitState, weights: LayerWeights) -> tuple[Gaussians, Bool[Tensor, "b"]]:
        return self._memo.get("baked", (lit, weights), lambda: lit.bake(weights))

    def _moved(self, lit: _LitState | None, state: EditState) -> Gaussians:
        """Return the scene with the last lit objects moved to new placements."""
        objects, place = list(state.objects or ()), self.place(state)
        parts = self._lit_objects(lit, state.weights) if lit is not None else []
        moved, feet = [], []
        for index, item in enumerate(objects):
            path, move = self._scenes.object_path(item), item.target_from_object
            own = [number for number, (known, _, _) in enumerate(parts) if known == path]
            if own:
                _, before, gaussians = parts[index if index in own else own[0]]
                moved.append(_moved_by(move @ before.inverse(), gaussians))
            else:
                moved.append(move.gaussians(self._scenes.gaussians(path)))
            feet.append((move.points(self._foot(item)), move.scale * self._scenes.placeable_object(item).base.radius))
        if self._joined is None or not self._joined.holds(place, moved):
            self._joined = _JoinedScene(place, moved)
        return self._joined.at(moved, feet)

    def _lit_objects(self, lit: _LitState, weights: LayerWeights) -> list[tuple[Path, Similarity, Gaussians]]:
        """Return the lit objects in the target's frame, with file and placement."""

        def make() -> list[tuple[Path, Similarity, Gaussians]]:
            (scene, is_object), items = self._baked(lit, weights), lit.state.objects or ()
            rows, paths = is_object.nonzero()[:, 0], [self._scenes.object_path(item) for item in items]
            counts = [self._scenes.gaussians(path).count for path in paths]
            if len(rows) != sum(counts):
                return []  # the files of the objects have changed
            parts = zip(paths, items, rows.split(counts), strict=True)
            return [(path, item.target_from_object, scene.select(part)) for path, item, part in parts]

        return self._memo.get("lit objects", (lit, weights), make)

    def _foot(self, item: ObjectPlacement) -> Float[Tensor, "k 3"]:
        """Sample points of an object's foot, in its own frame."""
        one = self._scenes.placeable_object(item)

        def make() -> Float[Tensor, "k 3"]:
            heights = (one.gaussians.means - one.base.point) @ one.base.up
            points = one.gaussians.means[(heights < _FOOT_SHARE * one.base.height) & (one.gaussians.opacities > 0.3)]
            return points[:: max(1, len(points) // _FOOT_POINTS)] if len(points) else one.base.point[None]

        return self._scenes.derive(f"foot {self._scenes.object_path(item)}", (one,), make)


class _JoinedScene:
    """A place and objects in one scene. A move changes only the objects and the place's Gaussians near their feet."""

    def __init__(self, place: Gaussians, objects: Sequence[Gaussians]) -> None:
        self._place, self._scene = place, concatenate([place, *objects])
        self._padded = place.with_sh_degree(self._scene.sh_degree)
        self._flattened = self._darkened = _NO_ROWS

    def holds(self, place: Gaussians, objects: Sequence[Gaussians]) -> bool:
        """Return whether the scene holds this place, and as many Gaussians of objects of the same degree."""
        degree = max(one.sh_degree for one in (place, *objects))
        count = place.count + sum(one.count for one in objects)
        return place is self._place and self._scene.count == count and self._scene.sh_degree == degree

    def at(self, objects: Sequence[Gaussians], feet: Sequence[tuple[Float[Tensor, "m 3"], float]]) -> Gaussians:
        """Replace the objects, flatten the support under them, and draw contact shadows of their feet."""
        place, scene, count = self._place, self._scene, self._place.count
        scene.sh[self._darkened] = self._padded.sh[self._darkened]
        for name in SHAPE:
            getattr(scene, name)[self._flattened] = getattr(place, name)[self._flattened]
        joined = concatenate(objects).with_sh_degree(scene.sh_degree)
        for field in fields(Gaussians):
            getattr(scene, field.name)[count:] = getattr(joined, field.name)
        around, flattened, darkened = scene.map(lambda rows: rows[:count]), [], []
        for one, (points, radius) in zip(objects, feet, strict=True):
            found = flattened_under(around, one)
            if found is not None:
                rows, flat = found
                flattened.append(rows)
                for name in SHAPE:
                    getattr(scene, name)[rows] = getattr(flat, name)
            darkened.append(_darken(scene.sh, place, points, radius))
        self._flattened, self._darkened = torch.cat([_NO_ROWS, *flattened]), torch.cat([_NO_ROWS, *darkened])
        return scene


def _moved_by(move: Similarity, gaussians: Gaussians) -> Gaussians:
    """Move Gaussians; the slow rotation of colours is skipped if the move has no rotation."""
    if float((move.rotation - torch.eye(3)).abs().max()) > _NO_TURN:
        return move.gaussians(gaussians)
    log_scales = gaussians.log_scales + math.log(move.scale)
    return replace(gaussians, means=move.points(gaussians.means), log_scales=log_scales)


def _darken(
    sh: Float[Tensor, "n k 3"], place: Gaussians, foot: Float[Tensor, "m 3"], radius: float
) -> Int[Tensor, "k"]:
    """Darken colours of a place, the first rows of `sh`, by a shadow around the foot; return the changed rows."""
    width = _SHADOW_WIDTH * radius
    middle = foot.mean(0)
    reach = float((foot - middle).norm(dim=1).max()) + 2 * width
    near = ((place.means - middle).abs().amax(1) < reach).nonzero()[:, 0]
    if not len(near):
        return near
    apart = torch.from_numpy(KDTree(foot.numpy()).query(place.means[near].numpy())[0]).float()
    gain = 1 - _DARKEST * torch.exp(-((apart / max(width, 1e-9)) ** 2))
    colors = replace(place.with_sh_degree(0).select(near), sh=sh[near])
    sh[near] = apply_gain(colors, gain[:, None].expand(-1, 3)).sh
    return near


class Pictures:
    """Pictures of one project."""

    def __init__(self, scenes: SceneCache) -> None:
        """Start without a lit scene."""
        self._scenes, self.lit = scenes, LitScenes(scenes)
        self._drawing = threading.Lock()

    def draw(self, kind: Kind, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        """Draw the target; raise ValueError if an input does not exist yet."""
        with self._drawing:  # a moved scene is valid until the next one is made
            return draw(self._scene(kind, state), camera)

    def _scene(self, kind: Kind, state: EditState) -> Gaussians:
        if kind == "lit":
            return self.lit.scene(state)
        if kind == "result":
            if not self._scenes.files.result.is_file():
                raise ValueError("There is no result yet: press Update result in Run.")
            return self._scenes.gaussians(self._scenes.files.result)
        return self.lit.pasted(state) if kind == "pasted" else self.lit.place(state)

    # the source

    def source_photo(self, index: int) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[int, int]]:
        """Read a photo of the source, upright and at most 1920 pixels long, and its own width and height."""
        path = self._scenes.photo(index)
        return self._scenes.derive("photo", (str(path), *stamp_of(path)), lambda: read_upright(path, _LONGEST_PX))

    def draw_source(
        self, which: Bool[Tensor, "n"] | None, camera: Cameras, *, photo: int | None, alone: bool
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Draw the source with the selection tinted, or the selection alone; `photo` replaces the rendered scene."""
        scene = self._scenes.scene("source")
        if alone and which is not None:
            return draw(scene.select(which), camera)
        flags = None if which is None or not bool(which.any()) else which[:, None].to(scene.means)
        if photo is None:
            found = render(scene, camera, features=flags)
            pixels = to_bytes(found.color[0])
            return pixels if flags is None else _tinted(pixels, found.features[0, ..., 0].numpy())
        pixels, size = self.source_photo(photo)
        view = PhotoView(size, (camera.width, camera.height))
        if flags is not None:
            own, drawn = self._scenes.cameras("source")[photo], view.drawn_size
            found = render(scene, own.resized(drawn[0] / own.width), outputs=frozenset(), features=flags)
            share = cv2.resize(found.features[0, ..., 0].numpy(), drawn)
            pixels = _tinted(cv2.resize(pixels, drawn, interpolation=cv2.INTER_AREA), share)
        return view.drawn(pixels)

    def outline(self, state: EditState, photo: int) -> list[list[tuple[float, float]]]:
        """Outline the object in one photo by the clicks, as the first round of `segment` does, over the photo's sides.

        Raise ValueError if no object is found.
        """
        cameras = self._scenes.cameras("source")
        scene = self._scenes.scene("source")
        small = cameras.resized(min(1.0, CUT_SIDE_PX / int(cameras.sizes.max())))
        prompts: dict[int, ViewPrompt] = {}
        for index, name in enumerate(cameras.names):
            given = prompt_of(state.prompts, name)
            if len(given.inside) or len(given.outside) or given.box is not None:
                size, here = self.source_photo(index)[1], small.sizes[index].tolist()
                prompts[index] = given.scaled(here[0] / size[0], here[1] / size[1])
        selected, _ = self._scenes.derive(
            "seed", (scene, state.prompts), lambda: seed_selection(scene, small, prompts=prompts)
        )
        lifted = view_operator(scene, small[photo], RenderOptions()).blend(selected.float()[:, None])[..., 0]
        image = torch.from_numpy(self.source_photo(photo)[0]).float() / 255
        image = resize(image, small[photo].width, small[photo].height)
        mask = grabcut_mask(image, lifted, prompts.get(photo, ViewPrompt())).numpy().astype(np.uint8)
        found = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
        sides = np.array([mask.shape[1], mask.shape[0]])
        return [[(round(float(x), 4), round(float(y), 4)) for x, y in (line[:, 0] + 0.5) / sides] for line in found]


def draw(scene: Gaussians, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
    """Render a scene in a view."""
    with torch.inference_mode():
        return to_bytes(render(scene, camera).color[0])


def to_bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Convert a picture in [0, 1] to bytes."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _tinted(pixels: UInt8[np.ndarray, "h w 3"], share: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Tint the selection in a picture, and draw its outline."""
    inside = share.clip(0, 1)[..., None]
    out = pixels * (1 - 0.4 * inside) + 0.4 * inside * 255 * np.array(TINT)
    out = np.ascontiguousarray(out.clip(0, 255).astype(np.uint8))
    edges = cv2.findContours((inside[..., 0] > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    r, g, b = (255 * value for value in TINT)
    cv2.drawContours(out, edges, -1, (r, g, b), max(2, pixels.shape[1] // 500), cv2.LINE_AA)
    return out
