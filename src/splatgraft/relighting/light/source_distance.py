"""How far away the sources of a light are: the depth of the scene in their direction, seen from the lit place.

A source that is seen from a place stands where the view towards it ends: nothing that the scene shows there, such as
the window's pane or the wall around it, blocks it.
"""

import math
from dataclasses import dataclass, replace

import torch

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.light import Light
from splatgraft.rendering import render

_SURFACE_ALPHA = 0.5
"""A pixel of a depth image above this alpha shows a surface."""


@dataclass(frozen=True)
class SourceDistanceSettings:
    """The view towards a source, all set by hand."""

    image: tuple[float, int] = (32.0, 16)
    """Focal length and width, pixels, of the depth image."""
    quantile: float = 0.25
    """Of the depths in that image: the distance to the source."""
    blockers_within: float = 0.7
    """Share of that distance within which occluders block the source."""


def with_source_distances(
    light: Light,
    scene: Gaussians,
    place: BoundingSphere,
    *,
    settings: SourceDistanceSettings = SourceDistanceSettings(),
) -> Light:
    """`light` with `blockers_within` of each source, where it was infinite, from the depth towards it.

    Args:
        light: At `place`; its sources are seen from there.
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
        settings: Of the view towards a source.
    """
    sources = []
    focal, width = settings.image
    for source in light.sources:
        if math.isfinite(source.blockers_within):
            sources.append(source)
            continue
        direction = torch.tensor(source.direction)
        # not core.directions.perpendicular: another roll of the camera would change results
        up = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
        pose = look_at(place.center[None], place.center + direction, up)
        rendered = render(scene, pinhole(pose, focal, width=width, height=width), outputs=frozenset({"depth"}))
        visible = (rendered.alpha > _SURFACE_ALPHA) & (rendered.depth > place.radius)
        distance = float(rendered.depth[visible].quantile(settings.quantile)) if bool(visible.any()) else math.inf
        sources.append(replace(source, blockers_within=settings.blockers_within * distance))
    return replace(light, sources=tuple(sources))
