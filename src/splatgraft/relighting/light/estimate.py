"""The light at a place of a scene, from its panorama there and from shadows and highlights on the surfaces around.

Peaks of the radiance that explains them become sources, the rest ambient light of degree 2. Where shadows on the
surface around the place show the sun (`sun.py`), it takes the place of the suns among them. A source that is seen from
the place stands where the view towards it ends: nothing that the scene shows there blocks it, such as a window's pane.

The ambient light is also made an environment map for programs that light meshes: what cameras photographed as the scene
shows it, in full resolution; the rest is the estimate's radiance, which has 320 directions. The estimate's sources are
left out: their directions are as bright as what is around them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from splatgraft.relighting.light.light import Light, LightSource, angular_radius_deg
from splatgraft.relighting.light.panorama import (
    DIRECTIONS,
    FARTHEST,
    NEAREST,
    SOLID_ANGLE,
    NoLight,
    cube_pixels,
    nearest_directions,
    panorama_at,
    place_surroundings,
    render_panorama,
    surroundings_at,
)
from splatgraft.relighting.light.radiance_model import LightEvidence, radiance_problem
from splatgraft.relighting.light.radiance_search import RadianceEstimate, search_radiance
from splatgraft.relighting.light.sun import Point, Sun, find_sun, set_sun, with_sun
from splatgraft.rendering import render

# the evidence; set by hand
_OVERHEAD = 0.5  # cosine to the up direction of what counts as ceiling, 60 degrees
_MIN_RADII, _MAX_RADII = 3.0, 8.0
"""Object radii: limits of the radius of the region of evidence; between them it is the cameras' median distance."""
_HIGHLIGHTS_WITHIN = 0.5  # radii of the region within which highlights count
_FAR = 0.9  # radii of the region from which on light counts as coming from outside of it

# what is a source; none of these numbers is sensitive
_OVER_MEDIAN = 4.0  # luminance of a peak over the median of all directions
_MIN_SHARE = 0.02  # smallest share of all light that comes from one direction of a peak
_MAX_SOURCES = 4
_NEIGHBOUR_COSINE = math.cos(math.radians(14))
"""Cosine of the largest angle to the brightest direction at which a direction belongs to its source."""
_SUN = 0.03  # steradians; a smaller clipped patch may show the sun, whose rays are parallel
_LAMP = 0.64  # sine of the height from which a source in a room is a lamp, and below it a window
_SEEN_NAMES, _UNSEEN_NAMES = ("window", "lamp"), ("sun or window", "sun or lamp")
"""Of sources with a surface behind them, and of those that no picture shows: low ones and high ones."""
_SAME_SOURCE = 0.94  # cosine between two sources from which they are one: 20 degrees
_SKY = 0.5  # share of `FARTHEST` from which nothing stands behind a bright patch
_UNSEEN_RADIUS_DEG = 1.0  # angular radius of a source that no camera saw, beside the uncertainty of its direction
_HALF_BIN_DEG = 4.0  # error of a direction that is known to one of `DIRECTIONS` alone
_CLIPPED_ERROR_DEG = 2.0  # error of the middle of a clipped patch

# the view towards a source; set by hand
_SOURCE_IMAGE = (32.0, 16)  # focal length and width, pixels, of the depth image
_SOURCE_QUANTILE = 0.25  # quantile of the depths in that image that is the distance to the source
_BLOCKERS_WITHIN = 0.7  # share of that distance within which occluders block the source

# the environment map
_SMOOTH_RAD = math.radians(8.0)
"""Width of the kernel that interpolates between the estimate's directions, which are 11 degrees apart; set by hand."""
_CHUNK = 65_536  # directions that are interpolated at a time


@dataclass(frozen=True)
class EstimatedLight:
    """The light at a place of a scene, and what is needed to have it at places nearby."""

    mean: Light
    """The mean over the posterior."""
    sun: Sun | None
    """Where shadows show it; it then stands for the suns of `mean`."""
    hidden: RadianceEstimate
    """What no camera recorded."""
    evidence: LightEvidence
    """What the estimate rests on."""
    place: BoundingSphere
    """Where the sources were estimated."""

    @property
    def light(self) -> Light:
        """The estimate, with the sun that shadows show."""
        return self.mean if self.sun is None else with_sun(self.mean, self.sun)

    def rest(self) -> Float[Tensor, "k 3"]:
        """Linear rgb radiance from all `DIRECTIONS` without the sources; `mean`'s ambient light is fitted to it."""
        return _split_peaks(self.hidden.radiance(self.evidence), self.evidence, within=math.inf)[1]

    def with_sun(self, sun: Sun, scene: Gaussians) -> "EstimatedLight":
        """With another sun, which nothing blocks that `scene` shows where the view from the place towards it ends."""
        named = replace(sun, name=sun.name or self._name_at(sun.direction))
        placed = with_source_distances(with_sun(self.mean, named), scene, self.place)
        return replace(self, sun=replace(named, blockers_within=placed.sources[0].blockers_within))

    def _name_at(self, direction: Float[Tensor, "3"]) -> str:
        """Of what shadows show in a direction: what pictures show there, or what may be there."""
        shown = (s for s in self.mean.sources if float(torch.tensor(s.direction) @ direction.float()) > _SAME_SOURCE)
        names = [source.name for source in shown if source.name in _SEEN_NAMES]
        return names[0] if names else _UNSEEN_NAMES[float(direction.float() @ self.evidence.up) > _LAMP]

    def at(self, captured: CapturedScene, place: BoundingSphere) -> "EstimatedLight | NoLight":
        """At a place in the same region: the same sources, and ambient light with what is near there."""
        if place.radius == self.place.radius and torch.equal(place.center, self.place.center):
            return self
        scene = captured.usable.gaussians
        panorama = panorama_at(scene, place)
        if isinstance(panorama, NoLight):
            return panorama
        evidence = replace(self.evidence, around=place_surroundings(scene, captured.cameras, place))
        _, rest = _split_peaks(self.hidden.radiance(evidence), evidence, within=math.inf)
        mean = replace(self.mean, ambient=_ambient_of(rest), **_seen_shares(evidence))
        return replace(self, evidence=evidence, mean=mean)


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
        object_gaussians: The object itself, if it stands there: its shading and its shadow are evidence, but it is not
            part of the surroundings.
        sun_through: Points and their shadows, as for `light.sun.set_sun`: the estimate then has this sun.
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
    hidden = search_radiance(radiance_problem(evidence))
    sources, rest = _split_peaks(hidden.radiance(evidence), evidence, within=region.radius)
    mean = with_source_distances(Light(sources, _ambient_of(rest), **_seen_shares(evidence)), scene, place)
    found = EstimatedLight(mean, None, hidden, evidence, place)
    sun = set_sun(sun_through, whole) if sun_through else find_sun(whole, region)
    return found if sun is None else found.with_sun(sun, scene)


def region_around(place: BoundingSphere, cameras: Cameras) -> BoundingSphere:
    """What is looked at for the light at a place, from about the distance of the cameras."""
    distance = float((cameras.centers - place.center).norm(dim=1).median())
    return BoundingSphere(place.center, max(_MIN_RADII * place.radius, min(distance, _MAX_RADII * place.radius)))


def _seen_shares(evidence: LightEvidence) -> dict[str, float]:
    seen = evidence.around.seen
    overhead = DIRECTIONS @ evidence.up > _OVERHEAD
    return {"coverage": float(seen.mean()), "unseen_up": float(1 - seen[overhead].mean())}


def _split_peaks(
    radiance: Float[Tensor, "k 3"], evidence: LightEvidence, *, within: float
) -> tuple[tuple[LightSource, ...], Float[Tensor, "k 3"]]:
    """The brightest of the `DIRECTIONS` above the horizon as sources, brightest first, and the radiance without them.

    What is bright below the horizon is a surface, and stays ambient light. Occluders farther away than `within` do not
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


def _ambient_of(rest: Float[Tensor, "k 3"]) -> Float[Tensor, "9 3"]:
    """Harmonics of degree 2 of radiance from all `DIRECTIONS`."""
    return fit_sh(DIRECTIONS, rest, torch.ones(len(DIRECTIONS)))


def _source(
    group: Bool[Tensor, "k"], extra: Float[Tensor, "p 3"], evidence: LightEvidence, *, within: float
) -> LightSource:
    """The source of the directions in `group`, whose radiance over the background is `extra`."""
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
        name = _SEEN_NAMES[float(direction @ evidence.up) > _LAMP] if distance < _SKY * FARTHEST else "sun"
        # a small patch may show the sun through a window; a large one stands where the panorama shows it
        distance = math.inf if size < _SUN else distance
        radius = angular_radius_deg(size)
        return LightSource((x, y, z), (r, g, b), radius, _CLIPPED_ERROR_DEG, name=name, distance=distance)
    away = torch.rad2deg(torch.acos((towards @ direction).clamp(-1, 1)))
    spread = float((weight * away**2).sum() / weight.sum().clamp_min(1e-9)) ** 0.5
    error, name = math.hypot(spread, _HALF_BIN_DEG), _UNSEEN_NAMES[float(direction @ evidence.up) > _LAMP]
    return LightSource((x, y, z), (r, g, b), _UNSEEN_RADIUS_DEG, error, 1.0, name, blockers_within=within)


def _mean_distance(distances: Float[Tensor, "p"], weight: Float[Tensor, "p"]) -> float:
    """Their weighted harmonic mean."""
    nearness = float((weight / distances).sum() / weight.sum().clamp_min(1e-9))
    return 1 / nearness if nearness > 0 else math.inf


def with_source_distances(light: Light, scene: Gaussians, place: BoundingSphere) -> Light:
    """`light` with `blockers_within` of each source, where it was infinite, from the depth towards it.

    Args:
        light: At `place`; its sources are seen from there.
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
    """
    sources = []
    focal, width = _SOURCE_IMAGE
    for source in light.sources:
        if math.isfinite(source.blockers_within):
            sources.append(source)
            continue
        direction = torch.tensor(source.direction)
        # not core.directions.perpendicular: another roll of the camera would change results
        up = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
        pose = look_at(place.center[None], place.center + direction, up)
        rendered = render(scene, pinhole(pose, focal, width=width, height=width), outputs=frozenset({"depth"}))
        visible = rendered.depth > place.radius
        distance = float(rendered.depth[visible].quantile(_SOURCE_QUANTILE)) if bool(visible.any()) else math.inf
        sources.append(replace(source, blockers_within=_BLOCKERS_WITHIN * distance))
    return replace(light, sources=tuple(sources))


def equirectangular_directions(height: int) -> Float[Tensor, "h w 3"]:
    """Unit directions of an environment map's pixels, twice as wide as high, as Blender's world has them.

    The top row looks along +z, the middle column along +x, and columns to the right turn towards -y, as seen from
    inside.
    """
    polar = math.pi * (torch.arange(height) + 0.5)[:, None] / height
    azimuth = 2 * math.pi * (0.5 - (torch.arange(2 * height) + 0.5) / (2 * height))[None]
    return torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos() + 0 * azimuth], -1)


def environment_radiance(
    found: EstimatedLight, captured: CapturedScene, place: BoundingSphere, directions: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """Linear rgb radiance at a place without the sources of the estimate's light, at least 0.

    Args:
        found: The estimate at `place`.
        captured: The scene without the object.
        place: What is nearer than half of its radius is left out.
        directions: Unit, world frame.
    """
    height, width, _ = directions.shape
    flat, face = directions.reshape(-1, 3), max(height, 1)
    cube = render_panorama(captured.usable.gaussians, place.center, size=face, nearest=NEAREST * place.radius)
    shown = cube.radiance.reshape(-1, 3)[cube_pixels(flat, face)]
    around, rest = found.evidence.around, found.rest()
    # a source that was photographed is cut down to what is around it
    is_cut = (rest < around.radiance).any(1, keepdim=True)
    limit = torch.where(is_cut, rest, math.inf)[nearest_directions(flat)]
    smooth = _interpolated(torch.cat([around.seen[:, None], _hidden(found, rest)], 1), flat)
    radiance = torch.minimum(smooth[:, :1] * shown, limit) + smooth[:, 1:]
    return radiance.reshape(height, width, 3)


def _hidden(found: EstimatedLight, rest: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """What of `rest` no camera recorded.

    A sun that shadows show dims the ambient light, so that the surface is as bright as before. Here that dims only what
    no camera recorded, by as much as gives the surface the same ambient irradiance, but not below 0.
    """
    seen = found.evidence.around.radiance
    hidden = (rest - seen).clamp_min(0)
    up = found.evidence.up if found.sun is None else found.sun.normal.to(DIRECTIONS)
    dimming = float(found.light.ambient.norm() / found.mean.ambient.norm().clamp_min(1e-9))
    cosine = (DIRECTIONS @ up).clamp_min(0)
    by_all, by_seen, by_hidden = (cosine @ (part @ LUMINANCE) for part in (rest, torch.minimum(rest, seen), hidden))
    return hidden * ((dimming * by_all - by_seen) / by_hidden.clamp_min(1e-9)).clamp_min(0)


def _interpolated(values: Float[Tensor, "k c"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """`values` of all `DIRECTIONS`, smoothly interpolated."""
    parts = []
    for part in directions.split(_CHUNK):
        weights = ((part @ DIRECTIONS.T - 1) / _SMOOTH_RAD**2).exp()
        parts.append(weights @ values / weights.sum(1, keepdim=True))
    return torch.cat(parts)
