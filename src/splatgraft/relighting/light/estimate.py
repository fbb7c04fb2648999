"""The light at a place of a scene, from its panorama there and from shadows and highlights on the surfaces around."""

import math
from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.direction_estimate import DirectionEstimate, DirectionSettings, estimate_direction
from splatgraft.relighting.light.fusion import LightFusionSettings, fuse_light
from splatgraft.relighting.light.highlight_evidence import HighlightSettings, find_highlights
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import Panorama, cube_cameras, render_panorama
from splatgraft.relighting.light.source_distance import with_source_distances
from splatgraft.relighting.shading.normals import estimate_normals
from splatgraft.rendering import render

_SURFACE_ALPHA = 0.5
"""A pixel of a depth image above this alpha shows a surface."""


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
class LevelSettings:
    """Brightness of the light from what the surfaces around reflect."""

    within: float = 3.0
    """Object radii within which surfaces count; set by hand."""
    faintest: float = 0.3
    """Opacity below which a Gaussian is left out; set by hand."""
    fewest: tuple[int, int] = (50, 30)
    """Gaussians, and upward ones among them; with fewer nothing is measured; set by hand."""
    upward: float = 0.7
    """Cosine between normal and up, at least, of a surface that faces up; set by hand."""
    albedo: float = 0.4
    """Linear albedo of a mean surface; an assumption."""
    darkest: float = 0.002
    """sRGB; darker channels count as this."""
    unseen: float = 0.25
    """Share of the surroundings; where so much is missing, surfaces count as much as the panorama; set by hand."""
    most: float = 9.0
    """Most factor between the two that is believed; set by hand."""


@dataclass(frozen=True)
class LightEstimateSettings:
    """All settings of `estimate_light`."""

    place: PlaceSettings = field(default_factory=PlaceSettings)
    """Of the panorama."""
    level: LevelSettings = field(default_factory=LevelSettings)
    """Of the brightness."""
    direction: DirectionSettings = field(default_factory=DirectionSettings)
    """Of shadows, and of both kinds of evidence together."""
    highlights: HighlightSettings = field(default_factory=HighlightSettings)
    """Of highlights."""
    fusion: LightFusionSettings = field(default_factory=LightFusionSettings)
    """Of panorama and evidence."""
    radius: tuple[float, float] = (3.0, 8.0)
    """Object radii: limits of the radius of the surroundings; between them it is the cameras' median distance; set by
    hand."""
    wider: float = 1.5
    """Factor on that radius for a second look where the near surroundings have little evidence; set by hand."""
    clear: float = 0.35
    """Confidence above which there is no second look; set by hand."""
    occluders_within: float = 1.4
    """Radii of the surroundings within which Gaussians may cast shadows; set by hand."""
    highlights_within: float = 0.5
    """Radii of the surroundings within which highlights count; set by hand."""


def estimate_light(
    scene: Gaussians,
    place: BoundingSphere,
    cameras: Cameras,
    *,
    object_gaussians: Gaussians | None = None,
    settings: LightEstimateSettings = LightEstimateSettings(),
) -> Light | NoLight:
    """Estimate the light in the middle of `place`.

    Args:
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
        cameras: Of the scene's capture.
        object_gaussians: The object itself, if it stands there: it casts shadows, but is not part of the panorama.
        settings: Of all methods.
    """
    lights = estimate_lights(scene, place, cameras, object_gaussians=object_gaussians, settings=settings)
    return lights if isinstance(lights, NoLight) else lights.leveled


@dataclass(frozen=True)
class EstimatedLights:
    """The light at a place in two brightnesses."""

    by_panorama: Light
    """As bright as what was captured."""
    leveled: Light
    """As bright as panorama and surfaces around suggest together."""


def estimate_lights(
    scene: Gaussians,
    place: BoundingSphere,
    cameras: Cameras,
    *,
    object_gaussians: Gaussians | None = None,
    settings: LightEstimateSettings = LightEstimateSettings(),
) -> EstimatedLights | NoLight:
    """As `estimate_light`, with the light before its brightness is leveled too."""
    panorama = panorama_at(scene, place, settings=settings.place)
    if isinstance(panorama, NoLight):
        return panorama
    up = estimate_up(cameras)
    whole = scene if object_gaussians is None else concatenate([scene, object_gaussians])
    distance = float((cameras.centers - place.center).norm(dim=1).median())
    least, most = settings.radius
    surroundings = BoundingSphere(place.center, max(least * place.radius, min(distance, most * place.radius)))
    estimate, surroundings = _direction_around(whole, cameras, surroundings, up, settings)
    reflected = _reflected_irradiance(scene, place, cameras, settings.level)
    light = fuse_light(
        panorama, estimate, up, estimated_within=surroundings.radius, reflected=reflected, settings=settings.fusion
    )
    light = with_source_distances(light, scene, place)
    return EstimatedLights(light, _leveled(light, reflected, up, settings.level))


def _direction_around(
    whole: Gaussians,
    cameras: Cameras,
    surroundings: BoundingSphere,
    up: Float[Tensor, "3"],
    settings: LightEstimateSettings,
) -> tuple[DirectionEstimate | None, BoundingSphere]:
    """The estimate from the surroundings, or from wider ones where those have little evidence; and which were used.

    Near shadows are the best evidence for the light that reaches the place, but a bare table has none.
    """
    found: tuple[DirectionEstimate | None, BoundingSphere] = (None, surroundings)
    center, radius = surroundings.center, surroundings.radius
    for wide in (radius, settings.wider * radius):
        part = whole.select((whole.means - center).norm(dim=1) < settings.occluders_within * wide)
        normals = estimate_normals(part, cameras)
        near, region = BoundingSphere(center, settings.highlights_within * wide), BoundingSphere(center, wide)
        highlights = find_highlights(part, normals, cameras, region=near, settings=settings.highlights)
        estimate = estimate_direction(
            part, normals, region=region, up=up, highlights=highlights, settings=settings.direction
        )
        if estimate is not None and (found[0] is None or estimate.confidence > found[0].confidence):
            found = (estimate, region)
        if estimate is not None and estimate.confidence > settings.clear:
            break
    return found


def _leveled(light: Light, reflected: float | None, up: Float[Tensor, "3"], settings: LevelSettings) -> Light:
    """`light` scaled towards the irradiance that surfaces around reflect (weighted geometric mean).

    Much of the light on a place comes from parts that were never captured, so the panorama alone is off by a factor of
    two or more. The surfaces around reflect all of it. They count as much as the panorama where `settings.unseen` of
    it is missing, and not at all where it is complete.
    """
    if reflected is None:
        return light
    captured = float(light.irradiance(up[None]).mean())
    share = 0.5 * min(1.0, (1 - light.coverage) / settings.unseen)
    most = math.log(settings.most)
    factor = math.exp(share * max(-most, min(most, math.log(reflected / max(captured, 1e-9)))))
    sources = [replace(s, irradiance=tuple(factor * v for v in s.irradiance)) for s in light.sources]
    return replace(light, sources=tuple(sources), ambient=factor * light.ambient)


def _reflected_irradiance(
    scene: Gaussians, place: BoundingSphere, cameras: Cameras, settings: LevelSettings
) -> float | None:
    """Gray irradiance on the upward surfaces around, if their albedo is that of a mean surface; None without any."""
    near = (scene.means - place.center).norm(dim=1) < settings.within * place.radius
    part = scene.select(near & (scene.opacities > settings.faintest))
    fewest, fewest_upward = settings.fewest
    if part.count < fewest:
        return None
    upward = estimate_normals(part, cameras).vectors @ estimate_up(cameras) > settings.upward
    area = part.opacities * part.scales.sort(1).values[:, 1:].prod(1) * upward
    if int(upward.sum()) < fewest_upward:
        return None
    reflected = linear_from_srgb(rgb_from_dc(part.sh[:, 0]).clamp(settings.darkest, 1)).mean(1)
    return math.pi * float((area * reflected).sum() / area.sum()) / settings.albedo


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
