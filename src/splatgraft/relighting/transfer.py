"""Physically based light transfer: objects placed in a scene get shading, shadows, bounce and gloss in layers.

Differential rendering (Debevec 1998) on Gaussians, without training: the light at the old and the new place is
estimated, and colours are multiplied by ratios of irradiance. Each step is one call and makes one value:

1. `find_scene_light`: the light of the target at the objects' place.
2. `prepare_object`: each object's normals, materials and old light.
3. `cast_shadows`: the shadows and the bounce of the objects.
4. `assemble_layers`: the composite with its change of light in layers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from splatgraft.compositing.composite import Composite
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.clock_sun import ClockSun
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.cast_shadows import cast_shadows
from splatgraft.relighting.layers import Relit, assemble_layers, pasted
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.sun import Point
from splatgraft.relighting.prepared_object import SourceLight, SourceScene, find_source_light, prepare_object
from splatgraft.relighting.scene_light import find_scene_light


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
    given = sources or [None] * len(composite.objects)
    placed = [(i, p, s) for i, (p, s) in enumerate(zip(composite.objects, given, strict=True), 1) if p.gaussians.count]
    if not placed:
        return pasted(composite, "No object is placed: nothing to light.")
    captured = CapturedScene(composite.target.select(~composite.erased), cameras, clock)
    spheres = [bounding_sphere(one.in_target()) for _, one, _ in placed]
    scene = find_scene_light(captured, spheres, light=light, reach=options.reach, sun_through=options.sun_through)
    if isinstance(scene, NoLight):
        return pasted(composite, f"{scene.reason} The object is pasted as it is.")
    objects, old_lights = [], dict[tuple[int, int], SourceLight]()
    for number, one, source in placed:
        # copies of one object were captured in one light
        key = (id(one.gaussians), id(source))
        if key not in old_lights:
            old_lights[key] = find_source_light(one.gaussians, source)
        old = old_lights[key]
        objects.append(prepare_object(one, source, cameras, source_light=old, light=scene.light, number=number))
    merged, is_object = composite.merged()
    views, budget = cameras.spread(options.fitted_views), options.budget(merged.count)
    shadows = cast_shadows(scene, objects, merged.select(~is_object), views=views, budget=budget)
    return assemble_layers(merged, scene, objects, shadows)
