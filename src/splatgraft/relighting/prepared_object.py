"""Preparation of a placed object for the light at its new place.

1. Find the light in the object's capture (`find_source_light`).
2. Estimate normals and materials in the object's own frame (`capture_object`). They do not depend on the placement.
3. Place the object: turn these values, splat shadow maps, and compute self-visibility (`prepare_object`).
4. Move the results with the object (`PreparedObject.moved`). Step 3 is done again after a rotation, a change of scale,
   or a change of the sources' directions.
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
from splatgraft.relighting.light.light import Light, fit_ambient
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.samples import LightSamples, sample_light
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
    """The light; own frame in a `CapturedObject`, target's frame in a `PreparedObject`."""
    irradiance: Float[Tensor, "n 3"]
    """Linear rgb irradiance on each Gaussian under that light."""
    materials: Materials
    """Matt and glossy parts of the object's colours, in units of that light."""
    estimate: EstimatedLight | None
    """Evidence for the light, source's frame; None if the light was given."""


@dataclass(frozen=True)
class CapturedObject:
    """An object of n Gaussians as its capture shows it, in its own frame."""

    gaussians: Gaussians
    """The object."""
    normals: Normals
    """Normals of the Gaussians."""
    lighting: SourceLighting | None
    """Old light of the object; None if it is unknown."""
    described: str
    """Description of the old light, or the reason why it is unknown; empty without a source scene."""

    def notes(self, number: int) -> tuple[Note, ...]:
        """Describe the old light and the materials of the object of this number."""
        place = f"At the old place of object {number}: {self.described}"
        if self.lighting is None:
            unknown = f"The old light of object {number} is unknown: the object keeps its mean brightness."
            return (*([Note(place)] if self.described else []), Note(unknown, "warning"))
        gloss = _gloss_note(self.lighting.materials, self.gaussians)
        if isinstance(self.gaussians, KnownSurface):
            return (Note(f"Object {number} is a mesh: its shape and material are known.{gloss}"),)
        return (Note(place + gloss),)


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
    light: Light
    """The light that the object was prepared for."""
    maps: ObjectShadowMaps
    """Shadow maps for the samples of the light at the new place."""
    self_visibility: Float[Tensor, "n k"]
    """Share of every sample of the new light that the object lets through to its own Gaussians, in [0, 1]."""
    source_lighting: SourceLighting | None
    """Old light of the object; None if it is unknown."""
    notes: tuple[Note, ...]
    """Description of the old light, or the reason why it is unknown."""

    def is_for(self, placed: PlacedObject, light: Light) -> bool:
        """Return whether the object was prepared for this placement and this light."""
        same_light = light.sources == self.light.sources and torch.equal(light.ambient, self.light.ambient)
        old, new = self.target_from_object, placed.target_from_object
        return same_light and self._is_turned_as(placed) and torch.equal(new.translation, old.translation)

    def _is_turned_as(self, placed: PlacedObject) -> bool:
        old, new = self.target_from_object, placed.target_from_object
        return new.scale == old.scale and torch.equal(new.rotation, old.rotation)

    def moved(self, placed: PlacedObject, light: Light) -> "PreparedObject | None":
        """Translate the object to the place in `placed`, under a light from the same directions.

        The bounce keeps the colours of the light that the object was prepared for.

        Returns:
            The moved object; None if it was rotated or scaled, too, or if the light has other directions.
        """
        samples = sample_light(light)
        parts = [part for part in (samples.of_sources, samples.of_ambient) if len(part)]
        known = [part for part, _, _ in self.maps.occlusions]
        if not self._is_turned_as(placed) or len(parts) != len(known) or not all(map(_are_alike, parts, known)):
            return None
        new, old = placed.target_from_object, self.target_from_object
        center = self.sphere.center + (new.translation - old.translation).to(self.sphere.center)
        sphere = BoundingSphere(center, self.sphere.radius)
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


def _are_alike(one: LightSamples, other: LightSamples) -> bool:
    """Return whether the shadow maps of one light's samples are those of another's."""
    pairs = ((one.directions, other.directions), (one.distances, other.distances))
    return all(torch.equal(a, b) for a, b in pairs)


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


def capture_object(
    gaussians: Gaussians, source: SourceScene | None, cameras: Cameras, *, source_light: SourceLight
) -> CapturedObject:
    """Find an object's normals and materials, and the irradiance on it in its capture.

    Args:
        gaussians: The object, own frame.
        source: The scene that it was taken from; None if unknown.
        cameras: Cameras that see the object, own frame: those of its capture, which see it best, if they are known.
        source_light: Result of `find_source_light`.

    Raises:
        ValueError: The source gives another number of normals than the object has Gaussians.
    """
    old = source_light.light if isinstance(source_light, EstimatedLight) else source_light
    if isinstance(gaussians, KnownSurface):
        assert isinstance(old, Light)
        received = torch.full((gaussians.count, 3), math.pi)  # of white light
        lighting = SourceLighting(old, received, known_materials(gaussians), None)
        return CapturedObject(gaussians, _known(gaussians.normals), lighting, "")
    sphere = bounding_sphere(gaussians)
    views = object_views(gaussians, sphere, cameras)
    normals = _normals(gaussians, source, cameras, views)
    if source is None or not isinstance(old, Light):
        reason = old.reason if isinstance(old, NoLight) else ""
        return CapturedObject(gaussians, normals, None, reason)
    samples = sample_light(old)
    visible = self_visibility(gaussians, sphere, normals.vectors, samples)
    received = irradiance(samples, normals.vectors, sample_visibility=visible)
    materials = estimate_materials(gaussians, normals.vectors, views, reflected_light(old, samples, visible))
    estimate = source_light if isinstance(source_light, EstimatedLight) else None
    described = describe_light(old, estimate_up(source.cameras)) + ("." if estimate is not None else ", as given.")
    return CapturedObject(gaussians, normals, SourceLighting(old, received, materials, estimate), described)


def prepare_object(placed: PlacedObject, captured: CapturedObject, light: Light, *, number: int) -> PreparedObject:
    """Prepare one object for the light at its new place.

    Args:
        placed: Object and placement.
        captured: The object in its own frame.
        light: The light at the new place.
        number: Number of the object among all placed ones, from 1.
    """
    gaussians, turned = placed.in_target(), placed.target_from_object.rotation
    sphere, samples = bounding_sphere(gaussians), sample_light(light)
    normals = replace(captured.normals, vectors=captured.normals.vectors @ turned.to(captured.normals.vectors).T)
    lighting = captured.lighting
    if lighting is not None:
        lighting = replace(lighting, light=lighting.light.rotated(turned))
    visible = self_visibility(gaussians, sphere, normals.vectors, samples)
    radiance = _albedo(gaussians, lighting) * irradiance(samples, normals.vectors, sample_visibility=visible) / math.pi
    return PreparedObject(
        number=number,
        gaussians=gaussians,
        target_from_object=placed.target_from_object,
        sphere=sphere,
        normals=normals,
        light=light,
        maps=object_shadow_maps(gaussians, sphere, samples, radiance=radiance),
        self_visibility=visible,
        source_lighting=lighting,
        notes=captured.notes(number),
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
    gaussians: Gaussians, source: SourceScene | None, cameras: Cameras, views: tuple[ObjectView, ...]
) -> Normals:
    """Return the object's normals: the source's, or an estimate."""
    if source is None or source.normals is None:
        return fuse_normals(gaussians, views, estimate_normals(gaussians, cameras))
    if len(source.normals) != gaussians.count:
        raise ValueError(f"relight: expected {gaussians.count} normals, found {len(source.normals)}")
    return _known(source.normals)


def _known(normals: Float[Tensor, "n 3"]) -> Normals:
    sure = torch.ones(len(normals))
    return Normals(vectors=normals, confidence=sure, seen=sure > 0)
