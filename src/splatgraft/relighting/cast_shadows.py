"""Shadows of a composite: of objects on the scene and on one another, and of the scene on objects.

The package `shadows` lists the steps and their functions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.relighting.normals import raised
from splatgraft.relighting.prepared_object import PreparedObject
from splatgraft.relighting.scene_light import SceneLight
from splatgraft.relighting.shadows.receivers import RIM, Receivers, shade_receivers
from splatgraft.relighting.shadows.scene_ratio import (
    SceneRatio,
    light_sums,
    ratio_from_sums,
    reachable,
    scene_ratio,
    scene_visibility,
)
from splatgraft.relighting.shadows.surface_views import views_of_surface
from splatgraft.relighting.shadows.view_fit import fit_to_views

SHADOW_POWER = 1.3
"""Exponent of shadows under an estimated light when no observed shadow reveals the sun.

Such an estimate averages over the possible lights, so it has less contrast than the true one. Fitted by
benchmarks/fit_shadows.py."""


@dataclass(frozen=True)
class Shadows:
    """The shadows of a composite with objects of n Gaussians each."""

    receivers: Receivers
    """Gaussians of the scene that some object reaches, wide ones split at shadow edges."""
    on_scene: SceneRatio
    """Ratios of the receivers, by all objects together."""
    scene_visibility: tuple[Float[Tensor, "n k"], ...]
    """Share of every light sample that reaches each object's Gaussians past the scene, in [0, 1]."""
    on_objects: tuple[SceneRatio, ...]
    """Ratios of each object's Gaussians, by all other objects."""


def cast_shadows(
    scene: SceneLight, objects: Sequence[PreparedObject], drawn: Gaussians, *, views: Cameras, budget: int
) -> Shadows:
    """Cast the shadows of a composite.

    Args:
        scene: The light at the objects' place.
        objects: All objects, prepared for that light.
        drawn: The scene in the composite, flattened around the objects' feet.
        views: Cameras in which shadows are fitted to the visible surface; none for a quick draft.
        budget: Largest number of Gaussians that splitting may add to the scene.
    """
    power = SHADOW_POWER if scene.estimate is not None and scene.estimate.sun is None else 1.0
    receivers, ratio = _on_scene(scene, objects, drawn, views, budget)
    visibility = tuple(
        scene_visibility(scene.maps, raised(one.gaussians, one.normals.vectors), one.normals.vectors) for one in objects
    )
    return Shadows(
        receivers=receivers,
        on_scene=ratio.strengthened(power),
        scene_visibility=visibility,
        on_objects=tuple(
            _on_object(one, [other for other in objects if other is not one], shares).strengthened(power)
            for one, shares in zip(objects, visibility, strict=True)
        ),
    )


def _on_scene(
    scene: SceneLight, objects: Sequence[PreparedObject], drawn: Gaussians, views: Cameras, budget: int
) -> tuple[Receivers, SceneRatio]:
    """Find and split the receivers that some object reaches, and their ratios by all objects."""
    all_receivers = scene.receivers
    points, rims = all_receivers.gaussians.means, RIM * all_receivers.gaussians.scales.max(1).values
    reached = torch.zeros(len(points), dtype=torch.bool)
    for one in objects:
        reached |= reachable(points, one.sphere, scene.samples, farthest=scene.maps.region.radius, rims=rims)
    receivers = all_receivers.select(reached)
    receivers = replace(receivers, gaussians=drawn.select(receivers.origin))
    total: SceneRatio | None = None
    ambient_sums: list[Float[Tensor, "3 m 3"]] = []
    for one in objects:
        receivers, parents, ratio, ambient = shade_receivers(receivers, one.maps, budget=budget // len(objects))
        ambient_sums = [*(sums[:, parents] for sums in ambient_sums), ambient]
        if total is None:
            total = ratio
            continue
        total = replace(ratio, shadow=total.shadow[parents] * ratio.shadow, bounce=total.bounce[parents] + ratio.bounce)
    assert total is not None

    def ratio_at(points: Tensor, normals: Tensor, receiver: Tensor) -> Tensor:
        through, grey = receivers.sample_visibility[receiver], torch.ones(len(points))
        for one, ambient in zip(objects, ambient_sums, strict=True):
            sums = light_sums(one.maps, points, normals, sample_visibility=through, sources=True)
            found = ratio_from_sums(sums + ambient[:, receiver])
            grey = grey * (found.shadow + found.bounce).mean(1)
        return grey

    if not len(views):
        return receivers, total
    rest = torch.ones(drawn.count, dtype=torch.bool)
    rest[receivers.origin] = False
    whole = concatenate([receivers.gaussians, drawn.select(rest)])
    shown = views_of_surface(receivers, total, whole, views, ratio_at=ratio_at)
    return receivers, fit_to_views(total, whole, shown)


def _on_object(one: PreparedObject, others: Sequence[PreparedObject], visibility: Float[Tensor, "n k"]) -> SceneRatio:
    """Compute shadow and bounce of all other objects on one."""
    gaussians, normals = one.gaussians, one.normals.vectors
    shadow, bounce = torch.ones(gaussians.count, 3), torch.zeros(gaussians.count, 3)
    for other in others:
        ratio = scene_ratio(other.maps, gaussians.means, normals, sample_visibility=visibility)
        shadow, bounce = shadow * ratio.shadow, bounce + ratio.bounce
    return SceneRatio(shadow=shadow, bounce=bounce, slope=torch.zeros_like(shadow))
