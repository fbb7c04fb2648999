"""A placed object prepared for lighting: normals, shadow maps, self-visibility, and the light it was captured in.

All of it moves with the object and is cached; it is computed again after a rotation, a change of scale, or with other
light sources.
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
from splatgraft.relighting.light.estimate import EstimatedLight, NoLight, fit_light
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.shading.depth_normals import fuse_normals
from splatgraft.relighting.shading.irradiance import irradiance
from splatgraft.relighting.shading.materials import Materials, estimate_materials
from splatgraft.relighting.shading.normals import Normals, estimate_normals
from splatgraft.relighting.shading.object_views import ObjectView, object_views
from splatgraft.relighting.shading.reflected_light import reflected_light
from splatgraft.relighting.shadows.light_sampling import LightSamples, ambient_pairs, sample_light, source_pairs
from splatgraft.relighting.shadows.scene_ratio import ObjectShadowMaps, object_shadow_maps, self_visibility
from splatgraft.runtime.memo import Memo

_LEAST_TOLD = 0.03
"""Share of the object; less gloss is not reported."""


@dataclass(frozen=True)
class SourceScene:
    """The capture that an object comes from, without the object."""

    gaussians: Gaussians
    """In the object's own frame."""
    cameras: Cameras
    """Of the capture, in the same frame."""
    light: Light | None = None
    """At the object's place, in the same frame, where it is known; otherwise it is estimated."""
    normals: Float[Tensor, "n 3"] | None = None
    """Unit, of the object's Gaussians, outward, in the same frame, where they are known; otherwise estimated."""


@dataclass(frozen=True)
class SourceLighting:
    """The light that an object of n Gaussians was captured in."""

    light: Light
    """Target's frame."""
    irradiance: Float[Tensor, "n 3"]
    """Linear rgb on each Gaussian under that light."""
    materials: Materials
    """What of the object's colours is matt and what is gloss, in units of that light."""
    estimate: EstimatedLight | None
    """What the light rests on, source's frame; None where it was told."""


@dataclass(frozen=True)
class PreparedObject:
    """One placed object of n Gaussians, target's frame."""

    gaussians: Gaussians
    """Target's frame."""
    target_from_object: Similarity
    """The placement."""
    sphere: BoundingSphere
    """Of the Gaussians."""
    normals: Normals
    """Of the Gaussians."""
    maps: ObjectShadowMaps
    """For the samples of the light at the new place."""
    self_visibility: Float[Tensor, "n k"]
    """Share of every sample of the new light that the object lets through to its own Gaussians, in [0, 1]."""
    source_lighting: SourceLighting | None
    """None where it is not known."""
    notes: str | None
    """A sentence on the light it was captured in, or on why that is not known; None without a source scene."""


def prepare_object(
    placed: PlacedObject, source: SourceScene | None, cameras: Cameras, *, light: Light, index: int, cache: Memo
) -> PreparedObject:
    """Prepare one object for the light at its new place.

    Args:
        placed: Object and placement.
        source: The scene it was taken from; None where not known.
        cameras: Of the target's capture.
        light: At the new place.
        index: Of the object among all placed ones; part of the cache's keys.
        cache: Reused where only the object's position changed.

    Raises:
        ValueError: The source tells normals, and not one for each of the object's Gaussians.
    """
    samples = sample_light(light)
    name, key = f"prepared object {index}", (placed.gaussians, source, cameras, light.sources)
    cached: PreparedObject | None = cache.peek(name, key)
    if cached is not None and _same_pose(cached.target_from_object, placed.target_from_object):
        return _moved(cached, placed, samples)
    gaussians = placed.in_target()
    sphere = bounding_sphere(gaussians)
    # the object is seen best from where it was captured
    seen_from = cameras if source is None else placed.target_from_object.cameras(source.cameras)
    views = object_views(gaussians, sphere, seen_from)
    normals = _normals(placed, source, gaussians, seen_from, views)
    maps = object_shadow_maps(gaussians, sphere, samples)
    source_lighting, notes = None, None
    if source is not None:
        found = source.light or _source_light(placed, source, index, cache)
        if isinstance(found, NoLight):
            notes = found.reason
        else:
            estimate = found if isinstance(found, EstimatedLight) else None
            source_light = found.light if isinstance(found, EstimatedLight) else found
            notes = source_light.describe(estimate_up(source.cameras))
            notes += "." if estimate is not None else ", as given."
            source_light = source_light.rotated(placed.target_from_object.rotation)
            source_samples = sample_light(source_light)
            shares = self_visibility(maps, gaussians, normals.vectors, source_samples)
            received = irradiance(source_samples, normals.vectors, sample_visibility=shares)
            reflected = reflected_light(source_light, source_samples, shares)
            materials = estimate_materials(gaussians, normals.vectors, views, reflected)
            notes += _gloss_note(materials, gaussians)
            source_lighting = SourceLighting(source_light, received, materials, estimate)
    prepared = PreparedObject(
        gaussians=gaussians,
        target_from_object=placed.target_from_object,
        sphere=sphere,
        normals=normals,
        maps=maps,
        self_visibility=self_visibility(maps, gaussians, normals.vectors, samples),
        source_lighting=source_lighting,
        notes=notes,
    )
    cache.put(name, key, prepared)
    return prepared


def _gloss_note(materials: Materials, gaussians: Gaussians) -> str:
    """A sentence on what was found glossy; empty where nothing was."""
    size = gaussians.opacities * gaussians.scales.sort(1).values[:, 1:].prod(1)
    share = float((size * materials.share).sum() / size.sum())
    mirrors = float((size * materials.mirrors).sum() / size.sum())
    note = f" {100 * share:.0f}% of what the object showed was gloss." if share > _LEAST_TOLD else ""
    if mirrors > _LEAST_TOLD:
        note += f" {100 * mirrors:.0f}% of it is a mirror, whose reflections are only blurred."
    return note


def _normals(
    placed: PlacedObject,
    source: SourceScene | None,
    in_target: Gaussians,
    cameras: Cameras,
    views: tuple[ObjectView, ...],
) -> Normals:
    """The object's normals in the target's frame: those that the source tells, or an estimate."""
    if source is None or source.normals is None:
        neighbours = estimate_normals(in_target, cameras)
        return fuse_normals(in_target, views, neighbours, radius=bounding_sphere(in_target).radius)
    if len(source.normals) != in_target.count:
        raise ValueError(f"relight: expected {in_target.count} normals, found {len(source.normals)}")
    turned = source.normals @ placed.target_from_object.rotation.to(source.normals).T
    known = torch.ones(in_target.count)
    return Normals(vectors=turned, confidence=known, seen=known > 0)


def _same_pose(one: Similarity, other: Similarity) -> bool:
    return one.scale == other.scale and torch.equal(one.rotation, other.rotation)


def _moved(prepared: PreparedObject, placed: PlacedObject, samples: LightSamples) -> PreparedObject:
    """The object translated to where `placed` has it, under samples of other irradiance from the same directions."""
    shift = placed.target_from_object.translation - prepared.target_from_object.translation
    center = prepared.sphere.center + shift.to(prepared.sphere.center)
    window = replace(prepared.maps.ambient_maps.window, center=center)
    parts = [p for p in (source_pairs(samples)[0], ambient_pairs(samples)[0]) if len(p)]
    occlusions = tuple(
        (part, replace(occlusion, center=center), bias)
        for part, (_, occlusion, bias) in zip(parts, prepared.maps.occlusions, strict=True)
    )
    return replace(
        prepared,
        gaussians=placed.in_target(),
        target_from_object=placed.target_from_object,
        sphere=BoundingSphere(center, prepared.sphere.radius),
        maps=ObjectShadowMaps(replace(prepared.maps.ambient_maps, window=window), occlusions),
    )


def _source_light(placed: PlacedObject, source: SourceScene, index: int, cache: Memo) -> EstimatedLight | NoLight:
    """The light that object `index` was captured in, estimated once for all copies of one object."""
    gaussians = placed.gaussians
    for earlier in range(index):
        cached = cache.peek(f"source light {earlier}", (gaussians, source))
        if cached is not None:
            return cached

    def estimate() -> EstimatedLight | NoLight:
        # the object's shadow in its capture is evidence too
        place = bounding_sphere(gaussians)
        return fit_light(source.gaussians, place, source.cameras, object_gaussians=gaussians)

    return cache.get(f"source light {index}", (gaussians, source), estimate)
