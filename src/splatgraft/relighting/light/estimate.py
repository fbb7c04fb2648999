"""Estimate of the light at a place of a scene from its panorama and from shadows and highlights on the surfaces around.

1. Collect the evidence: panorama, shading of surfaces, highlights.
2. Find the radiance of 320 directions that explains it (`radiance_search.py`). If it is likelier without the brightest
   source that no camera saw, spread the radiance of unseen directions.
3. Turn peaks of that radiance into sources, and the rest into ambient light of degree 2.
4. If shadows on a level surface show a sun (`sun.py`), it replaces the distant sources, and out of doors all sources.
   Otherwise they are replaced by the sun that is known from the photos' clock or, out of doors, from a clear sky or as
   the brightest source that no camera saw (`known_sun.py`). It moves to the shadows. Out of doors its strength is the
   median of a posterior; in a room it is what the shadows show, or else that median. If the views show a clear sky
   (`sky.py`), the radiance that no camera saw is that of this sky, and the sun is added to it. In the shade of
   something that was not captured (`known_sun.OpenGround`) there is no sun.
5. Set the maximum distance of occluders that block each source, so that a pane does not block its window's light.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import fit_sh
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.evidence import find_highlights, find_shading_evidence
from splatgraft.relighting.light.known_sun import OpenGround, clear_ratio, known_sun, sun_towards
from splatgraft.relighting.light.light import Light, LightSource, angular_radius_deg
from splatgraft.relighting.light.panorama import (
    DIRECTIONS,
    FARTHEST,
    SOLID_ANGLE,
    NoLight,
    panorama_at,
    place_surroundings,
    surroundings_at,
)
from splatgraft.relighting.light.radiance_model import LightEvidence, RadianceProblem, radiance_problem
from splatgraft.relighting.light.radiance_search import RadianceEstimate, search_radiance, source_costs
from splatgraft.relighting.light.sky import ClearSky, clear_sky_evidence
from splatgraft.relighting.light.sun import (
    UNSEEN_RADIUS_DEG,
    Point,
    Sun,
    find_sun,
    set_sun,
    sun_near,
    with_sun,
    without_sun,
)
from splatgraft.rendering import render

# the evidence; set by hand
_MIN_RADII, _MAX_RADII = 3.0, 8.0  # object radii; bounds of the radius of the region of evidence
_HIGHLIGHTS_WITHIN = 0.5  # radii of the region within which highlights are evidence
_FAR = 0.9  # radii of the region beyond which a surface belongs to the distant surroundings

# sources; no result is sensitive to these numbers
_OVER_MEDIAN = 4.0  # luminance of a peak over the median of all directions
_MIN_SHARE = 0.02  # minimum share of one direction of a peak in all light
_MAX_SOURCES = 4
_NEIGHBOUR_COSINE = math.cos(math.radians(14))  # directions nearer to the brightest one belong to its source
_SUN = 0.03  # steradians; a smaller clipped patch may show the sun, whose rays are parallel
_LAMP = 0.64  # sine of the height above which a source in a room is named a lamp, otherwise a window
_SEEN_NAMES = ("window", "lamp")  # low and high sources in a room with a surface behind them
_SEEN_OUTDOORS = "bright patch"  # the same outdoors
_UNSEEN_NAMES = ("sun or window", "sun or lamp")  # low and high sources that no camera saw

# the view towards a source; set by hand
_SOURCE_QUANTILE = 0.25  # quantile of the depths in that view that is the distance to the source
_BLOCKERS_WITHIN = 0.7  # share of that distance within which occluders block the source


@dataclass(frozen=True)
class EstimatedLight:
    """The estimated light at a place of a scene, with the data to move it to places nearby."""

    mean: Light
    """Mean over the posterior."""
    found_sun: Sun | None
    """Sun that replaces the distant sources of `mean`, from shadows, the clock or, outdoors, a clear sky or shading;
    None without one."""
    ground: OpenGround | None
    """Ground that shows where something that was not captured hides `found_sun`; None without one, for one that was
    set by hand, and in a room."""
    hidden: RadianceEstimate
    """Radiance that no camera recorded."""
    sky: ClearSky | None
    """The clear sky that is part of `hidden`; None if the views show none."""
    evidence: LightEvidence
    """Evidence for the estimate."""
    place: BoundingSphere
    """Place of the light."""

    @cached_property
    def is_shaded(self) -> bool:
        """Whether something that was not captured shades the place from `found_sun`."""
        return self.ground is not None and self.ground.is_shaded(self.place)

    @property
    def sun(self) -> Sun | None:
        """The sun that shines on the place."""
        return None if self.is_shaded else self.found_sun

    @cached_property
    def light(self) -> Light:
        """The estimate, including the sun."""
        return self.mean if self.found_sun is None else replace(self._lit, ambient=_ambient_of(self.rest()))

    @cached_property
    def _lit(self) -> Light:
        """The mean light with the sun; all of its ambient light is multiplied by one factor."""
        assert self.found_sun is not None
        changed = without_sun if self.is_shaded else with_sun
        return changed(self.mean, self.found_sun, is_added=self.sky is not None)

    def rest(self) -> Float[Tensor, "k 3"]:
        """Return the linear rgb radiance of all `DIRECTIONS` without the sources, to which ambient light is fitted.

        A sun found from shadows dims the ambient light, so that the surface keeps its brightness. Recorded radiance
        stays: the part that no camera recorded is dimmed until the ambient irradiance on the surface agrees, or to 0.
        """
        rest = _split_peaks(self.hidden.radiance(self.evidence), self.evidence, within=math.inf)[1]
        if self.found_sun is None:
            return rest
        hidden = (rest - self.evidence.around.radiance).clamp_min(0)
        dimming = float(self._lit.ambient.norm() / self.mean.ambient.norm().clamp_min(1e-9))
        cosine = (DIRECTIONS @ self.found_sun.normal.to(DIRECTIONS)).clamp_min(0)
        of_all, of_hidden = (float(cosine @ (part @ LUMINANCE)) for part in (rest, hidden))
        left = max(dimming * of_all - (of_all - of_hidden), 0.0) / max(of_hidden, 1e-9)
        return rest - (1 - left) * hidden

    def with_sun(self, sun: Sun, scene: Gaussians) -> "EstimatedLight":
        """Replace the sun.

        The surface of `scene` at which the view towards the sun ends, such as a window's pane, does not block it.
        """
        named = replace(sun, name=sun.name or ("lamp" if math.isfinite(sun.distance) else self._name_at(sun.direction)))
        if self.sky is not None and sun.ratio is None:
            named = replace(named, ratio=clear_ratio(float(sun.direction @ self.sky.up)))
        mean = self.mean
        if self.evidence.is_sun(sun.distance):
            # by day nothing else is a source, so the sun replaces near ones, too
            mean = replace(mean, sources=tuple(replace(source, distance=math.inf) for source in mean.sources))
        lit = with_sun(mean, named, is_added=self.sky is not None)
        blockers_within = with_blocker_distances(lit, scene, self.place).sources[0].blockers_within
        return replace(self, mean=mean, found_sun=replace(named, blockers_within=blockers_within))

    def _name_at(self, direction: Float[Tensor, "3"]) -> str:
        """Name a distant source found from shadows.

        Outdoors it is the sun. In a room it has the name of a photographed source within 20 degrees, or else its
        possible kinds.
        """
        if self.evidence.is_outdoors:
            return "sun"
        near = (s for s in self.mean.sources if float(torch.tensor(s.direction) @ direction.float()) > 0.94)
        names = [source.name for source in near if source.name in _SEEN_NAMES]
        return names[0] if names else _UNSEEN_NAMES[float(direction.float() @ self.evidence.up) > _LAMP]

    def at(self, captured: CapturedScene, place: BoundingSphere) -> "EstimatedLight | NoLight":
        """Move the light to a place in the same region: keep the sources, and compute the ambient light there."""
        if place.radius == self.place.radius and torch.equal(place.center, self.place.center):
            return self
        scene = captured.usable.gaussians
        panorama = panorama_at(scene, place)
        if isinstance(panorama, NoLight):
            return panorama
        evidence = replace(self.evidence, around=place_surroundings(scene, captured.cameras, place))
        _, rest = _split_peaks(self.hidden.radiance(evidence), evidence, within=math.inf)
        mean = replace(self.mean, ambient=_ambient_of(rest), **_seen_shares(evidence))
        return replace(self, evidence=evidence, mean=mean, place=place)


def estimate_light(
    captured: CapturedScene,
    place: BoundingSphere,
    *,
    object_gaussians: Gaussians | None = None,
    sun_through: Sequence[Point] = (),
) -> EstimatedLight | NoLight:
    """Estimate the light in the middle of `place`.

    Args:
        captured: The scene without the object.
        place: The object's bounding sphere.
        object_gaussians: The object, if the scene was captured with it. Its shading and its shadow are evidence, but it
            is not part of the surroundings.
        sun_through: Points and their shadows, as for `light.sun.set_sun`; they replace the search for a sun.

    Returns:
        The estimate, or the reason why there is none.
    """
    scene, cameras = captured.usable.gaussians, captured.cameras
    panorama = panorama_at(scene, place)
    if isinstance(panorama, NoLight):
        return panorama
    region = region_around(place, cameras)
    whole = captured.usable if object_gaussians is None else captured.usable.with_object(object_gaussians)
    near = BoundingSphere(region.center, _HIGHLIGHTS_WITHIN * region.radius)
    evidence = LightEvidence(
        surfaces=find_shading_evidence(whole, region=region),
        highlights=find_highlights(whole, region=near),
        far=surroundings_at(scene, cameras, place.center, nearest=_FAR * region.radius),
        around=place_surroundings(scene, cameras, place),
        up=captured.up,
    )
    problem = radiance_problem(evidence)
    hidden = search_radiance(problem)
    sources, rest = _split_peaks(hidden.radiance(evidence), evidence, within=region.radius)
    if sources and sources[0].name in _UNSEEN_NAMES and _is_denied(sources[0], problem, evidence, rest):
        hidden = hidden.spread(evidence.far.seen)
        sources, rest = _split_peaks(hidden.radiance(evidence), evidence, within=region.radius)
    sky = clear_sky_evidence(captured) if evidence.is_outdoors else None
    known = None
    sun = set_sun(sun_through, whole) if sun_through else find_sun(whole, region, outdoors=evidence.is_outdoors)
    if sun is None:
        main = next(iter(sources), None)
        is_unseen = main is not None and main.name in _UNSEEN_NAMES
        known = known_sun(captured, main, sky, outdoors=evidence.is_outdoors, is_unseen=is_unseen)
        sun = None if known is None else sun_near(known.directions, known.log_density, whole, region, name=known.name)
    clear = None if sky is None or sun is None else sky.sky_with(sun.direction)
    if clear is not None and sun is not None:
        hidden = hidden.under(clear)
        sources, rest = _split_peaks(hidden.radiance(evidence), evidence, within=region.radius)
        # the sky tells the strength better than the edges of shadows, where Gaussians mix lit and shaded
        sun = replace(sun, ratio=None, name=sun.name or "sun")
    if sun is not None and not sun_through:
        # a decisive sun under a clear sky has that sky's strength
        is_doubted = known is not None if sun.ratio is None else evidence.is_sun(sun.distance)
        sun = sun_towards(sun, sky, problem, evidence, rest) if is_doubted else sun
    mean = with_blocker_distances(Light(sources, _ambient_of(rest), **_seen_shares(evidence)), scene, place)
    ground = None if sun is None or sun_through or not evidence.is_outdoors else OpenGround.around(whole, region, sun)
    found = EstimatedLight(mean, None, ground, hidden, clear, evidence, place)
    return found if sun is None else found.with_sun(sun, scene)


def region_around(place: BoundingSphere, cameras: Cameras) -> BoundingSphere:
    """Return the region of evidence for the light at a place: the cameras' median distance, within bounds."""
    distance = float((cameras.centers - place.center).norm(dim=1).median())
    return BoundingSphere(place.center, max(_MIN_RADII * place.radius, min(distance, _MAX_RADII * place.radius)))


def _seen_shares(evidence: LightEvidence) -> dict[str, float]:
    seen = evidence.around.seen
    overhead = DIRECTIONS @ evidence.up > 0.5  # 60 degrees
    return {"coverage": float(seen.mean()), "unseen_up": float(1 - seen[overhead].mean())}


def _split_peaks(
    radiance: Float[Tensor, "k 3"], evidence: LightEvidence, *, within: float
) -> tuple[tuple[LightSource, ...], Float[Tensor, "k 3"]]:
    """Split radiance into sources at its peaks above the horizon, brightest first, and the radiance without them.

    Peaks below the horizon are bright surfaces and remain ambient light. Occluders farther away than `within` do not
    block sources that no camera saw.
    """
    luminance = radiance @ LUMINANCE
    is_peak = luminance > _OVER_MEDIAN * luminance.median()
    is_peak &= luminance > _MIN_SHARE * luminance.sum()
    near = _NEIGHBOUR_COSINE < DIRECTIONS @ DIRECTIONS.T
    is_above = torch.minimum(DIRECTIONS @ evidence.up, evidence.around.clipped_direction @ evidence.up) > 0
    left, rest, sources = is_peak & is_above, radiance.clone(), []
    while bool(left.any()) and len(sources) < _MAX_SOURCES:
        i = int((luminance * left).argmax())
        group, ring = near[i] & left, near[i] & ~is_peak
        left &= ~near[i]
        background = radiance[ring].mean(0) if bool(ring.any()) else radiance.median(0).values
        sources.append(_source(group, (radiance[group] - background).clamp_min(0), evidence, within=within))
        rest[group] = torch.minimum(rest[group], background)
    return tuple(sorted(sources, key=lambda source: -source.luminance)), rest


def _is_denied(
    source: LightSource, problem: RadianceProblem, evidence: LightEvidence, rest: Float[Tensor, "k 3"]
) -> bool:
    """Return whether shading and highlights are likelier without a source than with it."""
    added = torch.tensor([0.0, sum(source.irradiance) / 3 / SOLID_ANGLE], dtype=torch.float64)
    without, with_it = source_costs(problem, evidence, rest.mean(1), torch.tensor(source.direction), added).tolist()
    return with_it > without


def _ambient_of(rest: Float[Tensor, "k 3"]) -> Float[Tensor, "9 3"]:
    """Fit spherical harmonics of degree 2 to radiance from all `DIRECTIONS`."""
    return fit_sh(DIRECTIONS, rest, torch.ones(len(DIRECTIONS)))


def _source(
    group: Bool[Tensor, "k"], extra: Float[Tensor, "p 3"], evidence: LightEvidence, *, within: float
) -> LightSource:
    """Make one source of the directions in `group`, whose radiance over the background is `extra`."""
    weight = extra @ LUMINANCE
    shares = evidence.visible_sources[group]
    visible = float(shares.sum())
    towards = evidence.around.clipped_direction[group] if visible > 0 else DIRECTIONS[group]
    direction = torch.nn.functional.normalize((weight[:, None] * towards).sum(0), dim=0)
    x, y, z = direction.tolist()
    r, g, b = (extra.sum(0) * SOLID_ANGLE).tolist()
    if visible > 0:
        size = max(visible, 0.1) * SOLID_ANGLE
        distance = _mean_distance(evidence.far.distance[group], weight * shares)
        name = _SEEN_OUTDOORS if evidence.is_outdoors else _SEEN_NAMES[float(direction @ evidence.up) > _LAMP]
        if distance >= 0.5 * FARTHEST:
            name = "sun"
        # a small patch may show the sun through a window; a large one has the distance of the panorama
        distance = math.inf if size < _SUN else distance
        # the middle of a clipped patch is about 2 degrees off
        return LightSource((x, y, z), (r, g, b), angular_radius_deg(size), 2.0, name=name, distance=distance)
    away = torch.rad2deg(torch.acos((towards @ direction).clamp(-1, 1)))
    spread = float((weight * away**2).sum() / weight.sum().clamp_min(1e-9)) ** 0.5
    error = math.hypot(spread, 4.0)  # `DIRECTIONS` are resolved to about 4 degrees
    name = _UNSEEN_NAMES[float(direction @ evidence.up) > _LAMP]
    return LightSource((x, y, z), (r, g, b), UNSEEN_RADIUS_DEG, error, 1.0, name, blockers_within=within)


def _mean_distance(distances: Float[Tensor, "p"], weight: Float[Tensor, "p"]) -> float:
    """Return the weighted harmonic mean."""
    nearness = float((weight / distances).sum() / weight.sum().clamp_min(1e-9))
    return 1 / nearness if nearness > 0 else math.inf


def with_blocker_distances(light: Light, scene: Gaussians, place: BoundingSphere) -> Light:
    """Set every infinite `blockers_within` of a light's sources from the depth of the scene towards the source.

    Args:
        light: At `place`; the directions of its sources are as seen from there.
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
    """
    sources = []
    for source in light.sources:
        if math.isfinite(source.blockers_within):
            sources.append(source)
            continue
        direction = torch.tensor(source.direction)
        # core.directions.perpendicular would roll the camera differently and change results
        up = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
        pose = look_at(place.center[None], place.center + direction, up)
        rendered = render(scene, pinhole(pose, 32.0, width=16, height=16), outputs=frozenset({"depth"}))
        visible = rendered.depth > place.radius
        seen = float(rendered.depth[visible].quantile(_SOURCE_QUANTILE)) if bool(visible.any()) else math.inf
        sources.append(replace(source, blockers_within=_BLOCKERS_WITHIN * min(seen, source.distance)))
    return replace(light, sources=tuple(sources))
