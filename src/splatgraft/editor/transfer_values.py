"""The values of a light transfer, kept so that the next one after a move computes only changed values."""

from collections.abc import Callable, Sequence
from typing import Any

import torch

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.clock_sun import ClockSun
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.memo import Memo
from splatgraft.relighting import Light, RelightOptions, Relit, SourceScene
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.cast_shadows import cast_shadows
from splatgraft.relighting.layers import assemble_layers, pasted
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.prepared_object import PreparedObject, find_source_light, prepare_object
from splatgraft.relighting.scene_light import SceneLight, find_scene_light

_SOURCE_LIGHT = "source light"  # name in the memo


class TransferValues:
    """The values of the last transfer, which the next one reuses while they are valid."""

    def __init__(self, clock: Callable[[], ClockSun | None]) -> None:
        """Start without values; `clock` reads the sun by the clock of the target's photos."""
        self._memo, self._clock = Memo(), clock

    def is_moved(self, composite: Composite, cameras: Cameras, light: Light | None, options: RelightOptions) -> bool:
        """Return whether objects were moved since the light of the scene was found."""
        kept = self._memo.peek(_kind(light), _light_inputs(composite, cameras, light, options))
        return kept is not None and kept[0] != _poses(composite)

    def relight(
        self,
        composite: Composite,
        cameras: Cameras,
        *,
        sources: Sequence[SourceScene | None],
        light: Light | None,
        options: RelightOptions,
        exact: bool,
    ) -> Relit:
        """Transfer the light as `relight` does; unless `exact`, keep the sources found before a short move."""
        pairs = enumerate(zip(composite.objects, sources, strict=True), 1)
        placed = [(number, one, source) for number, (one, source) in pairs if one.gaussians.count]
        if not placed:
            return pasted(composite, "No object is placed: nothing to light.")
        scene = self._scene_light(composite, cameras, light, options, exact=exact)
        if isinstance(scene, NoLight):
            return pasted(composite, f"{scene.reason} The object is pasted as it is.")
        objects = [self._object(number, one, source, scene, exact=exact) for number, one, source in placed]
        merged, is_object = composite.merged()
        views, budget = cameras.spread(options.fitted_views), options.budget(merged.count)
        shadows = cast_shadows(scene, objects, merged.select(~is_object), views=views, budget=budget)
        return assemble_layers(merged, scene, objects, shadows)

    def share_source_light(
        self, pair: tuple[Gaussians, SourceScene], other: "TransferValues", theirs: tuple[Gaussians, SourceScene]
    ) -> None:
        """Copy the light at an object's old place from other values, instead of estimating it again.

        Args:
            pair: The object and its source scene here, for example with fewer Gaussians.
            other: The values that may hold the light.
            theirs: The same object and source scene there.
        """
        light = other._memo.peek(_SOURCE_LIGHT, theirs)
        if light is not None:
            self._memo.put(_SOURCE_LIGHT, pair, light)

    def _scene_light(
        self, composite: Composite, cameras: Cameras, light: Light | None, options: RelightOptions, *, exact: bool
    ) -> SceneLight | NoLight:
        kind, inputs = _kind(light), _light_inputs(composite, cameras, light, options)
        poses, kept = _poses(composite), self._memo.peek(kind, inputs)
        if kept is not None and kept[0] == poses:
            return kept[1]
        spheres = [bounding_sphere(one.in_target()) for one in composite.objects if one.gaussians.count]
        if kept is not None and not exact:
            latest = self._memo.peek(f"{kind}, moved", (kept[1],)) or kept[1]
            moved = latest.moved(spheres)
            if isinstance(moved, SceneLight):
                self._memo.put(f"{kind}, moved", (kept[1],), moved)
            if moved is not None:
                return moved
        captured = self._memo.get(
            "captured",
            (composite.target, composite.erased, cameras),
            lambda: CapturedScene(composite.target.select(~composite.erased), cameras, self._clock()),
        )
        found = find_scene_light(captured, spheres, light=light, reach=options.reach, sun_through=options.sun_through)
        if isinstance(found, SceneLight):
            self._memo.put(kind, inputs, (poses, found))
        return found

    def _object(
        self, number: int, placed: PlacedObject, source: SourceScene | None, scene: SceneLight, *, exact: bool
    ) -> PreparedObject:
        name, inputs = f"object {number}", (placed.gaussians, source, scene.captured.cameras)
        kept: PreparedObject | None = self._memo.peek(name, inputs)
        place = placed.target_from_object.translation
        if kept is not None and not (exact and not torch.equal(kept.target_from_object.translation, place)):
            moved = kept.moved(placed, scene.light)
            if moved is not None:
                return moved
        source_light = None
        if source is not None:
            # shared, because only the project's own object and its duplicates have a source
            pair = (placed.gaussians, source)
            source_light = self._memo.get(_SOURCE_LIGHT, pair, lambda: find_source_light(*pair))
        prepared = prepare_object(
            placed, source, scene.captured.cameras, source_light=source_light, light=scene.light, number=number
        )
        self._memo.put(name, inputs, prepared)
        return prepared


def _poses(composite: Composite) -> bytes:
    """Return the objects' placements as bytes."""
    moves = [one.target_from_object for one in composite.objects]
    return b"".join(
        part.numpy().tobytes() for m in moves for part in (torch.tensor(m.scale), m.rotation, m.translation)
    )


def _light_inputs(
    composite: Composite, cameras: Cameras, light: Light | None, options: RelightOptions
) -> tuple[Any, ...]:
    """Return the inputs of a scene's light, except the objects' placements."""
    return (composite.target, composite.erased, cameras, light, options.reach, repr(options.sun_through))


def _kind(light: Light | None) -> str:
    """Name the scene's light in the memo, which keeps an estimate while another light is given."""
    return "estimated light" if light is None else "given light"
