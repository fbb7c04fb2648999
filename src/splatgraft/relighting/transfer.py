"""Physically based light transfer: objects placed in a scene get shading, shadows, bounce and gloss in layers.

Differential rendering (Debevec 1998) on Gaussians, without training: the light at the old and the new place is
estimated, and colours are multiplied by ratios of irradiance. Each step is one call and makes one value:

1. `find_scene_light`: the light of the target at the objects' place.
2. `capture_object` and `prepare_object`: each object's normals, materials and old light, in its own frame, then placed.
3. `cast_shadows`: the shadows and the bounce of the objects.
4. `assemble_layers`: the objects' shading, by the light with those shadows, and all changes of light in layers.

`TransferValues` keeps these values, so that the next transfer after a move computes only the changed ones.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.clock_sun import ClockSun
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.cast_shadows import cast_shadows
from splatgraft.relighting.layers import Relit, assemble_layers, pasted
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.sun import Point
from splatgraft.relighting.prepared_object import (
    CapturedObject,
    PreparedObject,
    SourceLight,
    SourceScene,
    capture_object,
    find_source_light,
    prepare_object,
)
from splatgraft.relighting.scene_light import SceneLight, find_scene_light
from splatgraft.runtime.memo import Memo

_Captured = tuple[Gaussians, SourceScene | None]
"""An object and the scene that it was taken from."""


@dataclass(frozen=True)
class RelightOptions:
    """Length of shadows, sun, and number of Gaussians that may be added."""

    reach: float = 8.0
    """Maximum length of shadows, object radii from the object; the umbra of a distant source may be longer."""
    most_added: float = 0.3
    """Maximum number of Gaussians added by splitting, as a share of the composite's Gaussians; a maximum below 40,000
    is raised to it, but 0 adds none."""
    fitted_views: int = 8
    """Number of views of the target in which shadows are fitted to the visible surface, and in which Gaussians seen
    through it are shaded; 0 skips both, for a quick draft."""
    sun_through: tuple[Point, ...] = ()
    """Points of the target in pairs, world units: a point that casts a shadow, then the same point of its shadow. The
    estimated light gets the sun of this direction; several pairs are averaged. A given light ignores it."""

    def budget(self, count: int) -> int:
        """Return the number of Gaussians that splitting may add to a composite of `count`."""
        # 40,000 are enough for the edges of one shadow on a surface of many layers; set by hand
        return max(int(self.most_added * count), 40_000) if self.most_added > 0 else 0


def relight(
    composite: Composite,
    cameras: Cameras,
    *,
    sources: Sequence[SourceScene | None] = (),
    light: Light | None = None,
    clock: ClockSun | None = None,
    options: RelightOptions = RelightOptions(),
) -> Relit:
    """Light the objects of a composite by the target scene, and add their shadows and reflected light to it.

    Colours change by ratios of irradiance (differential rendering), without training and without images.

    Args:
        composite: The target with the objects placed in it.
        cameras: The target's cameras, which also give the up direction.
        sources: For each object the scene that it was taken from, without the object; its light is divided out. None
            if the scene is unknown, or no sources at all: the object then keeps its mean brightness.
        light: The light at the objects' place; None to estimate it from the target.
        clock: The sun by the clock of the target's photos, evidence for the estimate.
        options: Length of shadows, sun, and number of Gaussians that may be added.

    Returns:
        The composite with its change of light in layers. If no light can be estimated, the layers change nothing and
        `report` gives the reason.

    Raises:
        ValueError: The number of `sources` is neither 0 nor that of the objects, or the normals of a source do not fit
            its object.
    """
    if len(sources) not in (0, len(composite.objects)):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    sources = sources or [None] * len(composite.objects)
    values = TransferValues(lambda: clock)
    return values.relight(composite, cameras, sources=sources, light=light, options=options, exact=True)


class TransferValues:
    """The values of the last transfer, which the next one reuses while they are valid."""

    def __init__(self, clock: Callable[[], ClockSun | None]) -> None:
        """Start without values; `clock` reads the sun by the clock of the target's photos."""
        self._memo, self._clock = Memo(), clock
        self._source_lights: dict[tuple[int, int], tuple[_Captured, SourceLight]] = {}
        """Light at each object's old place, by the identities of the object and its source scene."""
        self._captured: dict[tuple[int, int], tuple[_Captured, CapturedObject]] = {}
        """Each object as its capture shows it, in the same way."""

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
        used = {_identity((one.gaussians, source)) for _, one, source in placed}
        self._source_lights = {key: known for key, known in self._source_lights.items() if key in used}
        self._captured = {key: known for key, known in self._captured.items() if key in used}
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

    def capture_objects(self, composite: Composite, cameras: Cameras, sources: Sequence[SourceScene | None]) -> None:
        """Compute what does not depend on placements: each object with its light at its old place."""
        for one, source in zip(composite.objects, sources, strict=True):
            if one.gaussians.count and source is not None:
                self._captured_object(one, source, cameras)

    def share_source_light(
        self, pair: tuple[Gaussians, SourceScene], other: "TransferValues", theirs: tuple[Gaussians, SourceScene]
    ) -> None:
        """Copy the light at an object's old place from other values, instead of estimating it again.

        Args:
            pair: The object here, for example with fewer Gaussians, and its source scene.
            other: The values that may hold the light.
            theirs: The same object and source scene there.
        """
        known = other._source_lights.get(_identity(theirs))
        if known is not None:
            self._source_lights[_identity(pair)] = (pair, known[1])

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
        if kept is not None and kept.is_for(placed, scene.light):
            return kept
        moved = None if kept is None or exact else kept.moved(placed, scene.light)
        if moved is not None:
            return moved
        captured = self._captured_object(placed, source, scene.captured.cameras)
        prepared = prepare_object(placed, captured, scene.light, number=number)
        self._memo.put(name, inputs, prepared)
        return prepared

    def _captured_object(self, placed: PlacedObject, source: SourceScene | None, cameras: Cameras) -> CapturedObject:
        pair = (placed.gaussians, source)
        key = _identity(pair)
        if key in self._captured:  # copies of one object were captured in one light
            return self._captured[key][1]
        if key not in self._source_lights:
            self._source_lights[key] = (pair, find_source_light(*pair))
        light = self._source_lights[key][1]
        if source is None:  # the target's cameras see the object, and so the result depends on its placement
            seen_from = placed.target_from_object.inverse().cameras(cameras)
            return capture_object(placed.gaussians, None, seen_from, source_light=light)
        captured = capture_object(placed.gaussians, source, source.cameras, source_light=light)
        self._captured[key] = (pair, captured)
        return captured


def _identity(pair: _Captured) -> tuple[int, int]:
    """Return the identities of both; a copy of the same object has the same."""
    return id(pair[0]), id(pair[1])


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
