"""Physically based light transfer: objects placed in a scene get shading, shadows, bounce and gloss in layers.

Differential rendering (Debevec 1998) on Gaussians: the light at the old and the new place is estimated, and colours are
multiplied by ratios of irradiance. No training, no rendered views. Four values are made one after another, each by one
call: the light of the scene, the prepared objects, their shadows, and the result in layers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.composite import Composite
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.cast_shadows import cast_shadows
from splatgraft.relighting.layers import Relit, assemble_layers, pasted
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.sun import Point
from splatgraft.relighting.prepared_object import SourceLight, SourceScene, find_source_light, prepare_object
from splatgraft.relighting.scene_light import find_scene_light

_MIN_BUDGET = 40_000
"""Gaussians that splitting may add to any scene: enough for the edges of one shadow on a surface of many layers; set by
hand."""


@dataclass(frozen=True)
class RelightOptions:
    """Reach of a transfer and the number of Gaussians it may add."""

    reach: float = 8.0
    """Shadows are computed up to this many object radii from the object."""
    most_added: float = 0.3
    """At most this share of the composite's Gaussians is added by splitting, or 40,000 where that is more; 0: none."""
    fitted_views: int = 8
    """Views of the target in which shadows are fitted to the surface that is seen, and what is behind it is shaded;
    0: none, for a quick draft."""
    sun_through: tuple[Point, ...] = ()
    """Points of the target in pairs, world units: one that casts a shadow, then the same point of its shadow. The
    estimated light gets the sun that goes through them; several pairs are averaged. Of no effect on a given light."""

    def budget(self, count: int) -> int:
        """Gaussians that splitting may add to a composite of `count`."""
        return max(int(self.most_added * count), _MIN_BUDGET) if self.most_added > 0 else 0


def relight(
    composite: Composite,
    cameras: Cameras,
    *,
    sources: Sequence[SourceScene | None] = (),
    light: Light | None = None,
    options: RelightOptions = RelightOptions(),
) -> Relit:
    """Light the objects of a composite by the target scene, and add their shadows and reflected light to it.

    Colours change by ratios of irradiance (differential rendering), without training and without images.

    Args:
        composite: The target with the objects placed in it.
        cameras: The target's cameras; from them follows the up direction.
        sources: For every object the scene that it was taken from, without the object, whose light is divided out;
            None, or no sources at all, where it is not known: the object then keeps its mean brightness.
        light: The light at the place of the objects; estimated from the target where not given.
        options: How far shadows reach and how many Gaussians may be added.

    Returns:
        The composite with its change of light in layers. Where no light can be estimated the layers change nothing
        and `report` gives the reason.

    Raises:
        ValueError: `sources` is neither empty nor one per object, or gives normals of another number of Gaussians.
    """
    if len(sources) not in (0, len(composite.objects)):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    given = sources or [None] * len(composite.objects)
    placed = [(i, p, s) for i, (p, s) in enumerate(zip(composite.objects, given, strict=True), 1) if p.gaussians.count]
    if not placed:
        return pasted(composite, "No object is placed: nothing to light.")
    captured = CapturedScene(composite.target.select(~composite.erased), cameras)
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
