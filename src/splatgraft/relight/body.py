"""A placed object made ready to be lit: its normals, depth maps and the light it had. Knows nothing of the scene.

All of it moves with the object: only a turn, another size or other sources ask for it to be made anew.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.composite import PlacedObject
from splatgraft.gaussians import Gaussians
from splatgraft.orbit import estimate_up
from splatgraft.relight.beams import ambient_pairs, beams_of, source_pairs
from splatgraft.relight.cache import RelightCache
from splatgraft.relight.cast import Beams
from splatgraft.relight.light import Light
from splatgraft.relight.normals import Normals, estimate_normals
from splatgraft.relight.object_shading import irradiance
from splatgraft.relight.place_light import light_at
from splatgraft.relight.scene_shading import Ball, ObjectMaps, ball_of, map_object, self_visibility
from splatgraft.similarity import Similarity


@dataclass(frozen=True)
class SourceScene:
    """The capture that an object comes from, without the object."""

    gaussians: Gaussians
    """In the object's own frame."""
    cameras: Cameras
    """That saw it, in the same frame."""


@dataclass(frozen=True)
class Body:
    """One placed object, target's frame."""

    gaussians: Gaussians
    target_from_object: Similarity
    ball: Ball
    normals: Normals
    maps: ObjectMaps
    own: Float[Tensor, "n k"]
    """Share of every bundle of the new light that the object lets through to itself."""
    then: Float[Tensor, "n 3"] | None
    """Linear irradiance where it was captured; None where nobody knows."""
    before: Light | None
    """That light, target's frame."""
    story: str | None
    """What was found out about that light."""


def set_body(
    placed: PlacedObject, source: SourceScene | None, cameras: Cameras, *, light: Light, index: int, cache: RelightCache
) -> Body:
    """The object `placed`, under the bundles of `light`; what is kept is moved where only the place changed."""
    beams = beams_of(light)
    key = (placed.gaussians, source, cameras, light.sources)
    kept: Body | None = cache.peek(f"body {index}", key)
    if kept is not None and _same_pose(kept.target_from_object, placed.target_from_object):
        return _moved(kept, placed, beams)
    gaussians = placed.in_target()
    ball = ball_of(gaussians)
    normals = estimate_normals(gaussians, cameras)
    maps = map_object(gaussians, ball, beams)
    then, before, story = None, None, None
    if source is not None:
        before, problem = _origin(placed.gaussians, source, index, cache)
        story = problem if before is None else before.describe(estimate_up(source.cameras)) + "."
        if before is not None:
            before = before.rotated(placed.target_from_object.rotation)
            bundles = beams_of(before)
            shares = self_visibility(maps, gaussians, normals.vectors, bundles)
            then = irradiance(bundles, normals.vectors, arrives=shares)
    own = self_visibility(maps, gaussians, normals.vectors, beams)
    body = Body(gaussians, placed.target_from_object, ball, normals, maps, own, then, before, story)
    cache.put(f"body {index}", key, body)
    return body


def _same_pose(one: Similarity, other: Similarity) -> bool:
    return one.scale == other.scale and torch.equal(one.rotation, other.rotation)


def _moved(body: Body, placed: PlacedObject, beams: Beams) -> Body:
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
        ball=Ball(center, body.ball.radius),
        maps=ObjectMaps(replace(body.maps.ambient_maps, window=window), occlusions),
    )


def _origin(own: Gaussians, source: SourceScene, index: int, cache: RelightCache) -> tuple[Light | None, str | None]:
    """The light that object `index` had, found once for all copies of one object."""
    for earlier in range(index):
        kept = cache.peek(f"origin {earlier}", (own, source))
        if kept is not None:
            return kept
    return cache.get(f"origin {index}", (own, source), lambda: _origin_light(own, source))


def _origin_light(own: Gaussians, source: SourceScene) -> tuple[Light | None, str | None]:
    """The light on an object where it was captured; its own shadow there helps to tell."""
    return light_at(source.gaussians, ball_of(own), source.cameras, also=own)
