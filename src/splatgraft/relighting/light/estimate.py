"""The light at a place of a scene, from its panorama there and from shadows and highlights on the surfaces around."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.relighting.light.highlight_evidence import HighlightSettings, find_highlights
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.light_from_radiance import RadianceSourceSettings, ambient_of, split_peaks
from splatgraft.relighting.light.panorama import Panorama, cube_cameras, render_panorama
from splatgraft.relighting.light.radiance_model import LightEvidence, RadianceSettings, radiance_problem, seen_sky
from splatgraft.relighting.light.radiance_search import RadianceEstimate, SearchSettings, search_radiance
from splatgraft.relighting.light.shading_evidence import (
    ShadingEvidenceSettings,
    find_shading_evidence,
)
from splatgraft.relighting.light.source_distance import with_source_distances
from splatgraft.relighting.light.surroundings import DIRECTIONS, surroundings_at
from splatgraft.relighting.shading.normals import estimate_normals
from splatgraft.rendering import render

_SURFACE_ALPHA = 0.5
"""A pixel of a depth image above this alpha shows a surface."""
_HUGE = 1e6
"""World units, and units of colour; such Gaussians are a format's or an optimiser's fault."""
_OVERHEAD = 0.5
"""Cosine to the up direction of what counts as ceiling, 60 degrees."""


@dataclass(frozen=True)
class NoLight:
    """The light at a place could not be estimated."""

    reason: str
    """A sentence for a report."""


@dataclass(frozen=True)
class PlaceSettings:
    """The panorama at a place, and when there is none; all set by hand."""

    size: int = 64
    """Pixels; width of a face of the cube map."""
    nearest: float = 0.5
    """Object radii within which Gaussians are left out of the panorama."""
    test_size: int = 24
    """Pixels; width of a face of the depth cube map that tests whether the place is inside something."""
    blocked_within: float = 0.4
    """Object radii; a nearer surface blocks the view."""
    most_blocked: float = 0.6
    """Share of views; with more blocked the place is inside something."""
    least_coverage: float = 0.1
    """Share of the surroundings that must be captured, in [0, 1]."""
    darkest: float = 2e-3
    """Mean linear radiance; a darker place has no light."""


@dataclass(frozen=True)
class LightEstimateSettings:
    """All settings of `estimate_light`."""

    place: PlaceSettings = field(default_factory=PlaceSettings)
    """Of the panorama that tests the place."""
    radiance: RadianceSettings = field(default_factory=RadianceSettings)
    """The density of the light: the numbers that are fitted."""
    search: SearchSettings = field(default_factory=SearchSettings)
    """Of its maxima."""
    shading: ShadingEvidenceSettings = field(default_factory=ShadingEvidenceSettings)
    """Of the surfaces around."""
    highlights: HighlightSettings = field(default_factory=HighlightSettings)
    """Of highlights on them."""
    peaks: RadianceSourceSettings = field(default_factory=RadianceSourceSettings)
    """Of sources."""
    radius: tuple[float, float] = (3.0, 8.0)
    """Object radii: limits of the radius of the surroundings that are evidence; between them it is the cameras' median
    distance."""
    scene_within: float = 1.4
    """Radii of the surroundings within which Gaussians may cast shadows."""
    highlights_within: float = 0.5
    """Radii of the surroundings within which highlights count."""
    far: float = 0.9
    """Radii of the surroundings from which on light counts as coming from outside of them."""


@dataclass(frozen=True)
class EstimatedLight:
    """The light at a place of a scene, and what is needed to have it at places nearby."""

    light: Light
    hidden: RadianceEstimate
    """What no camera recorded."""
    evidence: LightEvidence
    """What the estimate rests on."""
    tint: Float[Tensor, "3"]
    """Linear rgb of mean 1, of what was seen above the horizon; what no camera saw is taken to have it too."""
    region: BoundingSphere
    """Around the place: what is in it is near."""
    place: BoundingSphere
    """Where the sources were estimated."""

    def at(
        self,
        scene: Gaussians,
        cameras: Cameras,
        place: BoundingSphere,
        *,
        settings: PlaceSettings = PlaceSettings(),
    ) -> "EstimatedLight | NoLight":
        """At a place in the same region: the same sources, and ambient light with what is near there."""
        if place.radius == self.place.radius and torch.equal(place.center, self.place.center):
            return self
        scene = _usable(scene)
        panorama = panorama_at(scene, place, settings=settings)
        if isinstance(panorama, NoLight):
            return panorama
        around = surroundings_at(scene, cameras, place.center, nearest=settings.nearest * place.radius)
        evidence = replace(self.evidence, around=around)
        _, rest = split_peaks(self.hidden.radiance(evidence, self.tint), evidence, within=math.inf)
        light = replace(self.light, ambient=ambient_of(rest), **_seen_shares(evidence))
        return replace(self, evidence=evidence, light=light)


def estimate_light(
    scene: Gaussians,
    place: BoundingSphere,
    cameras: Cameras,
    *,
    object_gaussians: Gaussians | None = None,
    settings: LightEstimateSettings = LightEstimateSettings(),
) -> Light | NoLight:
    """Estimate the light in the middle of `place`; arguments as of `fit_light`."""
    found = fit_light(scene, place, cameras, object_gaussians=object_gaussians, settings=settings)
    return found if isinstance(found, NoLight) else found.light


def fit_light(
    scene: Gaussians,
    place: BoundingSphere,
    cameras: Cameras,
    *,
    object_gaussians: Gaussians | None = None,
    settings: LightEstimateSettings = LightEstimateSettings(),
) -> EstimatedLight | NoLight:
    """Estimate the light in the middle of `place`, with what it rests on.

    Args:
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
        cameras: Of the scene's capture.
        object_gaussians: The object itself, if it stands there: its shading and its shadow are evidence, but it is not
            part of the surroundings.
        settings: Of all parts.
    """
    scene = _usable(scene)
    panorama = panorama_at(scene, place, settings=settings.place)
    if isinstance(panorama, NoLight):
        return panorama
    up = estimate_up(cameras)
    distance = float((cameras.centers - place.center).norm(dim=1).median())
    least, most = settings.radius
    region = BoundingSphere(place.center, max(least * place.radius, min(distance, most * place.radius)))
    whole = scene
    if object_gaussians is not None:
        degree = max(scene.sh_degree, object_gaussians.sh_degree)
        whole = concatenate([scene.with_sh_degree(degree), object_gaussians.with_sh_degree(degree)])
    part = whole.select((whole.means - region.center).norm(dim=1) < settings.scene_within * region.radius)
    normals = estimate_normals(part, cameras)
    surfaces = find_shading_evidence(part, normals, region=region, settings=settings.shading)
    near = BoundingSphere(region.center, settings.highlights_within * region.radius)
    highlights = find_highlights(part, normals, cameras, region=near, settings=settings.highlights)
    evidence = LightEvidence(
        surfaces=surfaces,
        highlights=None if highlights is None else highlights.evidence(),
        far=surroundings_at(scene, cameras, place.center, nearest=settings.far * region.radius),
        around=surroundings_at(scene, cameras, place.center, nearest=settings.place.nearest * place.radius),
        up=up,
    )
    hidden = search_radiance(radiance_problem(evidence, settings=settings.radiance), settings=settings.search)
    mean = (surfaces.weights[:, None] * surfaces.colors).sum(0)
    sky = seen_sky(evidence.far, up, mean.clamp_min(1e-3))
    tint = sky / sky.mean().clamp_min(1e-6)
    radiance = hidden.radiance(evidence, tint)
    sources, rest = split_peaks(radiance, evidence, within=region.radius, settings=settings.peaks)
    light = with_source_distances(Light(sources, ambient_of(rest), **_seen_shares(evidence)), scene, place)
    return EstimatedLight(light, hidden, evidence, tint, region, place)


def _usable(scene: Gaussians) -> Gaussians:
    """The Gaussians whose values are finite and no larger than any camera or scene makes them."""
    good = torch.ones(scene.count, dtype=torch.bool)
    for values in (scene.means, scene.log_scales, scene.quaternions, scene.sh.flatten(1)):
        good &= (values.abs() < _HUGE).all(1)  # false for nan too
    return scene if bool(good.all()) else scene.select(good)


def _seen_shares(evidence: LightEvidence) -> dict[str, float]:
    seen = evidence.around.seen
    overhead = DIRECTIONS @ evidence.up > _OVERHEAD
    return {"coverage": float(seen.mean()), "unseen_up": float(1 - seen[overhead].mean())}


def panorama_at(
    scene: Gaussians, place: BoundingSphere, *, settings: PlaceSettings = PlaceSettings()
) -> Panorama | NoLight:
    """The panorama from the middle of `place`.

    Args:
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
        settings: Resolution, and when there is no panorama.
    """
    if scene.count == 0:
        return NoLight("The scene is empty.")
    rendered = render(scene, cube_cameras(place.center, settings.test_size), outputs=frozenset({"depth"}))
    blocked = (rendered.alpha > _SURFACE_ALPHA) & (rendered.depth < settings.blocked_within * place.radius)
    if float(blocked.float().mean()) > settings.most_blocked:
        return NoLight("The object is inside a wall or another thing: there is no light to be found there.")
    panorama = render_panorama(scene, place.center, size=settings.size, nearest=settings.nearest * place.radius)
    if panorama.coverage < settings.least_coverage:
        return NoLight(f"Only {100 * panorama.coverage:.0f}% of the object's surroundings were captured.")
    mean = float((panorama.radiance.mean(-1) * panorama.alpha * panorama.solid_angles).sum()) / (4 * math.pi)
    if mean < settings.darkest:
        return NoLight("There is no light at the object's place.")
    return panorama
