"""Preparation of a placed object for the light at its new place.

1. Find the light in the object's capture (`find_source_light`).
2. Estimate normals, splat shadow maps, and compute self-visibility and materials (`prepare_object`).
3. Move the results with the object (`PreparedObject.moved`). They are computed again after a rotation, a change of
   scale, or a change of the light sources.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.compositing.composite import PlacedObject
from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.clock_sun import ClockSun
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.description import describe_light
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.samples import sample_light
from splatgraft.relighting.materials import Materials, estimate_materials, known_materials, reflected_light
from splatgraft.relighting.normals import Normals, estimate_normals
from splatgraft.relighting.object_views import ObjectView, fuse_normals, object_views
from splatgraft.relighting.shading import irradiance
from splatgraft.relighting.shadows.scene_ratio import ObjectShadowMaps, object_shadow_maps, self_visibility
from splatgraft.runtime.note import Note

_MAX_ALBEDO = 0.8  # albedo of fresh snow and white paint

SourceLight = Light | EstimatedLight | NoLight | None
"""Light that an object was captured in: given, estimated, none found, or None without a source scene."""


@dataclass(frozen=True)
class SourceScene:
    """The capture that an object comes from, without the object; all in the object's own frame."""

    gaussians: Gaussians
    """Gaussians of the scene."""
    cameras: Cameras
    """Cameras of the capture."""
    light: Light | None = None
    """Known light at the object's place; None to estimate it."""
    normals: Float[Tensor, "n 3"] | None = None
    """Known normals of the object's Gaussians, unit, outward; None to estimate them."""
    clock: ClockSun | None = None
    """The sun by the clock of the photos, evidence for the estimate."""


@dataclass(frozen=True)
class SourceLighting:
    """The light that an object of n Gaussians was captured in."""

    light: Light
    """The light, target's frame."""
    irradiance: Float[Tensor, "n 3"]
    """Linear rgb irradiance on each Gaussian under that light."""
    materials: Materials
    """Matt and glossy parts of the object's colours, in units of that light."""
    estimate: EstimatedLight | None
    """Evidence for the light, source's frame; None if the light was given."""


@dataclass(frozen=True)
class PreparedObject:
    """One placed object of n Gaussians, target's frame."""

    number: int
    """Number of the object among all placed ones, from 1."""
    gaussians: Gaussians
    """The object's Gaussians, target's frame."""
    target_from_object: Similarity
    """Placement of the object."""
    sphere: BoundingSphere
    """Bounding sphere of the Gaussians."""
    normals: Normals
    """Normals of the Gaussians."""
    light_sources: tuple[LightSource, ...]
    """Sources of the light at the new place."""
    maps: ObjectShadowMaps
    """Shadow maps for the samples of the light at the new place."""
    self_visibility: Float[Tensor, "n k"]
    """Share of every sample of the new light that the object lets through to its own Gaussians, in [0, 1]."""
    source_lighting: SourceLighting | None
    """Old light of the object; None if it is unknown."""
    notes: tuple[Note, ...]
    """Description of the old light, or the reason why it is unknown."""

    def moved(self, placed: PlacedObject, light: Light) -> "PreparedObject | None":
        """Translate the object to the place in `placed`, under other ambient light.

        Returns:
            The moved object; None if it was rotated or scaled, too, or if the light has other sources.
        """
        old, new = self.target_from_object, placed.target_from_object
        if light.sources != self.light_sources or new.scale != old.scale or not torch.equal(new.rotation, old.rotation):
            return None
        center = self.sphere.center + (new.translation - old.translation).to(self.sphere.center)
        sphere = BoundingSphere(center, self.sphere.radius)
        samples = sample_light(light)
        parts = [part for part in (samples.of_sources, samples.of_ambient) if len(part)]
        occlusions = tuple(
            (part, replace(occlusion, center=center), bias)
            for part, (_, occlusion, bias) in zip(parts, self.maps.occlusions, strict=True)
        )
        return replace(
            self,
            gaussians=placed.in_target(),
            target_from_object=new,
            sphere=sphere,
            maps=ObjectShadowMaps(sphere, occlusions),
        )


def find_source_light(object_gaussians: Gaussians, source: SourceScene | None) -> SourceLight:
    """Return the light that an object was captured in, in its source's frame: the given one, or an estimate.

    The object's own shading and shadow in its capture are evidence, too. A known surface has the colours of its albedo,
    as under white light, whatever the source.
    """
    if isinstance(object_gaussians, KnownSurface):
        return Light((), fit_ambient(torch.ones(3)))
    if source is None:
        return None
    if source.light is not None:
        return source.light
    captured = CapturedScene(source.gaussians, source.cameras, source.clock)
    return estimate_light(captured, bounding_sphere(object_gaussians), object_gaussians=object_gaussians)


def prepare_object(
    placed: PlacedObject,
    source: SourceScene | None,
    cameras: Cameras,
    *,
    source_light: SourceLight,
    light: Light,
    number: int,
) -> PreparedObject:
    """Prepare one object for the light at its new place.

    Args:
        placed: Object and placement.
        source: The scene that the object was taken from; None if unknown.
        cameras: Cameras of the target's capture.
        source_light: Result of `find_source_light`.
        light: The light at the new place.
        number: Number of the object among all placed ones, from 1.

    Raises:
        ValueError: The source gives another number of normals than the object has Gaussians.
    """
    gaussians = placed.in_target()
    sphere = bounding_sphere(gaussians)
    # the capture's own cameras see the object best
    seen_from = cameras if source is None else placed.target_from_object.cameras(source.cameras)
    is_known = isinstance(gaussians, KnownSurface)
    views = () if is_known else object_views(gaussians, sphere, seen_from)
    normals = _known(gaussians.normals) if is_known else _normals(placed, source, gaussians, seen_from, views)
    samples, lighting, notes = sample_light(light), None, []
    estimate = source_light if isinstance(source_light, EstimatedLight) else None
    old = source_light.light if isinstance(source_light, EstimatedLight) else source_light
    if is_known and isinstance(old, Light):
        (visible,) = self_visibility(gaussians, sphere, normals.vectors, (samples,))
        received = torch.full((gaussians.count, 3), math.pi)  # of white light
        lighting = SourceLighting(old, received, known_materials(gaussians), None)
        gloss = _gloss_note(lighting.materials, gaussians)
        notes.append(Note(f"Object {number} is a mesh: its shape and material are known.{gloss}"))
    elif isinstance(old, Light) and source is not None:
        turned = old.rotated(placed.target_from_object.rotation)
        old_samples = sample_light(turned)
        visible, shares = self_visibility(gaussians, sphere, normals.vectors, (samples, old_samples))
        received = irradiance(old_samples, normals.vectors, sample_visibility=shares)
        materials = estimate_materials(gaussians, normals.vectors, views, reflected_light(turned, old_samples, shares))
        lighting = SourceLighting(turned, received, materials, estimate)
        described = describe_light(old, estimate_up(source.cameras)) + ("." if estimate is not None else ", as given.")
        notes.append(Note(f"At the old place of object {number}: {described}{_gloss_note(materials, gaussians)}"))
    else:
        (visible,) = self_visibility(gaussians, sphere, normals.vectors, (samples,))
        if isinstance(old, NoLight):
            notes.append(Note(f"At the old place of object {number}: {old.reason}"))
        unknown = f"The old light of object {number} is unknown: the object keeps its mean brightness."
        notes.append(Note(unknown, "warning"))
    received = irradiance(samples, normals.vectors, sample_visibility=visible)
    radiance = _albedo(gaussians, lighting) * received / math.pi
    return PreparedObject(
        number=number,
        gaussians=gaussians,
        target_from_object=placed.target_from_object,
        sphere=sphere,
        normals=normals,
        light_sources=light.sources,
        maps=object_shadow_maps(gaussians, sphere, samples, radiance=radiance),
        self_visibility=visible,
        source_lighting=lighting,
        notes=tuple(notes),
    )


def _albedo(gaussians: Gaussians, lighting: SourceLighting | None) -> Float[Tensor, "n 3"]:
    """Compute the share of light that the Gaussians reflect: their colour if the old light is unknown."""
    linear = linear_from_srgb(rgb_from_dc(gaussians.sh[:, 0]).clamp(0, 1))
    if lighting is not None:
        linear = math.pi * linear / lighting.irradiance.clamp_min(1e-6)
    return linear.clamp_max(_MAX_ALBEDO)


def _gloss_note(materials: Materials, gaussians: Gaussians) -> str:
    """Describe the object's gloss in a sentence; empty below 3 percent."""
    size = gaussians.opacities * gaussians.scales.sort(1).values[:, 1:].prod(1)
    share = float((size * materials.share).sum() / size.sum())
    mirrors = float((size * materials.mirrors).sum() / size.sum())
    note = f" {100 * share:.0f}% of the light from the object was gloss." if share > 0.03 else ""
    if mirrors > 0.03:
        note += f" {100 * mirrors:.0f}% of its surface is a mirror, whose reflections are only blurred."
    return note


def _normals(
    placed: PlacedObject,
    source: SourceScene | None,
    in_target: Gaussians,
    cameras: Cameras,
    views: tuple[ObjectView, ...],
) -> Normals:
    """Return the object's normals in the target's frame: the source's, or an estimate."""
    if source is None or source.normals is None:
        neighbours = estimate_normals(in_target, cameras)
        return fuse_normals(in_target, views, neighbours)
    if len(source.normals) != in_target.count:
        raise ValueError(f"relight: expected {in_target.count} normals, found {len(source.normals)}")
    return _known(source.normals @ placed.target_from_object.rotation.to(source.normals).T)


def _known(normals: Float[Tensor, "n 3"]) -> Normals:
    sure = torch.ones(len(normals))
    return Normals(vectors=normals, confidence=sure, seen=sure > 0)
