"""A placed object made ready to be lit: its normals, depth maps and the light it had. Knows nothing of the scene.

All of it moves with the object: only a turn, another size or other sources ask for it to be made anew.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.composite import PlacedObject
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.relighting.light.estimate import estimate_light
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.shading.irradiance import irradiance
from splatgraft.relighting.shading.normals import Normals, estimate_normals
from splatgraft.relighting.shadows.light_sampling import ambient_pairs, sample_light, source_pairs
from splatgraft.relighting.shadows.occlusion import LightSamples
from splatgraft.relighting.shadows.scene_ratio import ObjectShadowMaps, object_shadow_maps, self_visibility
from splatgraft.runtime.memo import Memo


@dataclass(frozen=True)
class SourceScene:
    """The capture that an object comes from, without the object."""

    gaussians: Gaussians
    """In the object's own frame."""
    cameras: Cameras
    """That saw it, in the same frame."""


@dataclass(frozen=True)
class PreparedObject:
    """One placed object, target's frame."""

    gaussians: Gaussians
    target_from_object: Similarity
    ball: BoundingSphere
    normals: Normals
    maps: ObjectShadowMaps
    own: Float[Tensor, "n k"]
    """Share of every bundle of the new light that the object lets through to itself."""
    then: Float[Tensor, "n 3"] | None
    """Linear irradiance where it was captured; None where nobody knows."""
    before: Light | None
    """That light, target's frame."""
    story: str | None
    """What was found out about that light."""


def prepare_object(
    placed: PlacedObject, source: SourceScene | None, cameras: Cameras, *, light: Light, index: int, cache: Memo
) -> PreparedObject:
    """The object `placed`, under the bundles of `light`; what is kept is moved where only the place changed."""
    beams = sample_light(light)
    key = (placed.gaussians, source, cameras, light.sources)
    kept: PreparedObject | None = cache.peek(f"body {index}", key)
    if kept is not None and _same_pose(kept.target_from_object, placed.target_from_object):
        return _moved(kept, placed, beams)
    gaussians = placed.in_target()
    ball = bounding_sphere(gaussians)
    normals = estimate_normals(gaussians, cameras)
    maps = object_shadow_maps(gaussians, ball, beams)
    then, before, story = None, None, None
    if source is not None:
        before, problem = _origin(placed.gaussians, source, index, cache)
        story = problem if before is None else before.describe(estimate_up(source.cameras)) + "."
        if before is not None:
            before = before.rotated(placed.target_from_object.rotation)
            bundles = sample_light(before)
            shares = self_visibility(maps, gaussians, normals.vectors, bundles)
            then = irradiance(bundles, normals.vectors, arrives=shares)
    own = self_visibility(maps, gaussians, normals.vectors, beams)
    body = PreparedObject(gaussians, placed.target_from_object, ball, normals, maps, own, then, before, story)
    cache.put(f"body {index}", key, body)
    return body


def _same_pose(one: Similarity, other: Similarity) -> bool:
    return one.scale == other.scale and torch.equal(one.rotation, other.rotation)


def _moved(body: PreparedObject, placed: PlacedObject, beams: LightSamples) -> PreparedObject:
    shift = placed.target_from_object.translation - body.target_from_object.translation
    center = body.ball.center + shift.to(body.ball.center)
    window = replace(body.maps.ambient_maps.window, center=center)
    parts = [p for p in (source_pairs(beams)[0], ambient_pairs(beams)[0]) if len(p)]
    occlusions = tuple(
        (part, replace(occlusion, center=center), bias)
        for part, (_, occlusion, bias) in zip(parts, body.maps.occlusions, strict=True)
    )
    return replace(
        body,
        gaussians=placed.in_target(),
        target_from_object=placed.target_from_object,
        ball=BoundingSphere(center, body.ball.radius),
        maps=ObjectShadowMaps(replace(body.maps.ambient_maps, window=window), occlusions),
    )


def _origin(own: Gaussians, source: SourceScene, index: int, cache: Memo) -> tuple[Light | None, str | None]:
    """The light that object `index` had, found once for all copies of one object."""
    for earlier in range(index):
        kept = cache.peek(f"origin {earlier}", (own, source))
        if kept is not None:
            return kept
    return cache.get(f"origin {index}", (own, source), lambda: _origin_light(own, source))


def _origin_light(own: Gaussians, source: SourceScene) -> tuple[Light | None, str | None]:
    """The light on an object where it was captured; its own shadow there helps to tell."""
    return estimate_light(source.gaussians, bounding_sphere(own), source.cameras, also=own)
