"""True pictures of what is placed, by our own renderer: pasted, lit, finished, and what lies behind them.

Knows nothing about browsers.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.composite import Composite
from splatgraft.editor.scenes import Scenes
from splatgraft.editor.state import EditState
from splatgraft.formats import read_capture
from splatgraft.gaussians import Gaussians
from splatgraft.relight import Light, RelightCache, RelightOptions, Relit, SourceScene, relight
from splatgraft.relight.exposure import relight_by_gain
from splatgraft.rendering import render
from splatgraft.splitting import split_around

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

    def __init__(self, scenes: Scenes) -> None:
        """Nothing made yet."""
        self._scenes = scenes
        self._cache = RelightCache()
        self._made: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def is_lit(self, state: EditState) -> bool:
        """Whether the light transfer of this state is there already, or takes no time."""
        made = self._made.get("relit")
        if not self._scenes.files.transfers_light:
            return True
        return made is not None and same_inputs(made[0], self._light_inputs(state))

    def relit(self, state: EditState) -> Relit:
        """The light transfer of this state, in layers.

        Raises: ValueError where a file is missing.
        """
        return self._keep("relit", self._light_inputs(state), lambda: self._relight(state))

    def drafted(self, state: EditState) -> Relit:
        """The same in a fraction of the time: shadows have coarse edges, and at first the object keeps its brightness.

        Raises: ValueError where a file is missing.
        """
        return self._keep("draft", self._light_inputs(state), lambda: self._draft(state))

    def picture(
        self, kind: Kind, state: EditState, camera: Cameras, *, draft: bool = False
    ) -> UInt8[np.ndarray, "h w 3"]:
        """One picture from one camera; with `draft` its light is the one that is there soonest.

        Raises: ValueError where what it shows is not there yet.
        """
        if kind == "Photograph":
            return self._photograph(camera)
        if kind in ("Mask", "Depth"):
            return self._mask(state, camera) if kind == "Mask" else self._depth(state, camera)
        if kind == "Shadow layer":
            return self._shadow(state, camera, draft=draft)
        color = render(self._scene(kind, state, draft=draft), camera).color
        assert color is not None
        return _bytes(color[0])

    def light_note(self) -> str:
        """What `Light transfer` shows where project.toml asks for less than the physical one."""
        light_by = self._scenes.files.light_by
        what = {"gain": "exposure and white balance of the object alone", "off": "nothing: the object as captured"}
        return (
            "" if light_by == "transfer" else f"{what[light_by]}, as project.toml asks ([relight] light = {light_by})"
        )

    def source_picture(self, which: Bool[Tensor, "n"] | None, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        """The source scene, or those of its Gaussians that `which` names."""
        scene = self._scenes.gaussians(self._scenes.files.source_scene)
        color = render(scene if which is None else scene.select(which), camera).color
        assert color is not None
        return _bytes(color[0])

    def _scene(self, kind: Kind, state: EditState, *, draft: bool) -> Gaussians:
        if kind == "Result":
            if not self._scenes.files.result.is_file():
                raise ValueError("Result: expected a finished run, found none yet")
            return self._scenes.gaussians(self._scenes.files.result)
        if kind == "Light transfer":
            return self.lit_scene(state, draft=draft)
        composite = self._composite(state)
        if kind == "Target alone":
            inputs = (composite.target, composite.erased)
            return self._keep("bare", inputs, lambda: composite.target.select(~composite.erased))
        return self._pasted(composite)[0]

    def lit_scene(self, state: EditState, *, draft: bool = False) -> Gaussians:
        """What the step `relight` would write, or a draft of it.

        Raises: ValueError where a file is missing.
        """
        if self._scenes.files.light_by == "off":
            return self._pasted(self._composite(state))[0]
        if self._scenes.files.light_by == "gain":
            composite = self._composite(state)
            return self._keep("gained", (composite,), lambda: self._gained(composite, state))
        relit = self._soonest(state) if draft else self.relit(state)
        placed = [one.in_target() for one in self._composite(state).objects]

        def make() -> Gaussians:
            return split_around(relit.bake(state.weights), relit.is_object, placed)[0]

        return self._keep("lit scene", (relit, state.weights), make)

    def _gained(self, composite: Composite, state: EditState) -> Gaussians:
        cameras, sources = self._scenes.cameras(self._scenes.files.target_cameras), self._scenes.source_scenes(state)
        adjusted, _ = relight_by_gain(composite, cameras, sources=sources)
        return split_around(*adjusted.bake(), [one.in_target() for one in composite.objects])[0]

    def _pasted(self, composite: Composite) -> tuple[Gaussians, Bool[Tensor, "n"]]:
        """What the step `compose` would write."""
        placed = [one.in_target() for one in composite.objects]
        return self._keep("pasted", (composite,), lambda: split_around(*composite.bake(), placed))

    def _mask(self, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        composite = self._composite(state)
        gaussians, is_object = self._pasted(composite)
        features = render(gaussians, camera, outputs=frozenset(), features=is_object[:, None].float()).features
        assert features is not None
        return _bytes(features[0].expand(-1, -1, 3))

    def _depth(self, state: EditState, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        composite = self._composite(state)
        gaussians, _ = self._pasted(composite)
        depth = render(gaussians, camera, outputs=frozenset({"depth"})).depth
        assert depth is not None
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
            raise ValueError(f"Shadow layer: expected the physical transfer, found {self.light_note()}")
        relit = self._soonest(state) if draft else self.relit(state)
        layers = self._keep("layers", (relit, state.weights), lambda: relit.ratio(state.weights))
        # half grey is unchanged, so that both what is darkened and what is brightened can be seen
        seen = render(relit.gaussians, camera, outputs=frozenset(), features=(0.5 * layers).clamp(0, 1))
        assert seen.features is not None
        return _bytes(seen.features[0] + 0.5 * (1 - seen.alpha[0])[..., None])

    def _photograph(self, camera: Cameras) -> UInt8[np.ndarray, "h w 3"]:
        path = self._scenes.files.target_cameras
        stamp = path.stat().st_mtime_ns if path.is_file() else 0
        capture = self._keep("capture", (path, stamp), lambda: read_capture(self._scenes.files.target_capture))
        if camera.names[0] not in capture.cameras.names:
            raise ValueError("Photograph: expected one of the target's cameras, found a free view; step to a camera")
        image = capture.image(capture.cameras.names.index(camera.names[0]))
        return cv2.resize(_bytes(image), (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    def _soonest(self, state: EditState) -> Relit:
        return self.relit(state) if self.is_lit(state) else self.drafted(state)

    def _relight(self, state: EditState) -> Relit:
        options, sources = self._scenes.files.relighting, self._scenes.source_scenes(state)
        made = self._made.get("draft")
        found = None if made is None or not same_inputs(made[0], self._light_inputs(state)) else made[1]
        if found is None or found.light is None or state.light is not None:
            return self._transferred(state, sources, state.light, options)
        # the draft looked for the light already, at this very place
        relit = self._transferred(state, sources, found.light, options)
        return replace(relit, report=(*found.report[:1], *relit.report[1:]))

    def _draft(self, state: EditState) -> Relit:
        sources = self._scenes.source_scenes(state)
        if "relit" not in self._made:
            # where the object comes from takes half of the first time
            sources = [None] * len(sources)
        return self._transferred(state, sources, state.light, replace(self._scenes.files.relighting, most_added=0.0))

    def _transferred(
        self, state: EditState, sources: list[SourceScene | None], light: Light | None, options: RelightOptions
    ) -> Relit:
        cameras = self._scenes.cameras(self._scenes.files.target_cameras)
        return relight(
            self._composite(state), cameras, sources=sources, light=light, options=options, cache=self._cache
        )

    def _composite(self, state: EditState) -> Composite:
        inputs = (self._scenes.gaussians(self._scenes.files.target_scene), state.objects, state.erased)
        return self._keep("composite", inputs, lambda: self._scenes.composite(state))

    def _light_inputs(self, state: EditState) -> tuple[Any, ...]:
        return (self._composite(state), state.light, repr(self._scenes.files.relighting))

    def _keep(self, name: str, inputs: tuple[Any, ...], make: Any) -> Any:
        made = self._made.get(name)
        if made is None or not same_inputs(made[0], inputs):
            made = (inputs, make())
            self._made[name] = made
        return made[1]


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


def same_inputs(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    """Whether two lists of inputs are the very same objects; numbers, texts and bytes count by value."""
    return len(a) == len(b) and all(
        x is y or (isinstance(x, int | float | str | bytes) and x == y) for x, y in zip(a, b, strict=True)
    )


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
