"""A `Light` from radiance sorted into directions: peaks become sources, the rest ambient light of degree 2."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.directions import fit_sh
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.light.light import LightSource, angular_radius_deg
from splatgraft.relighting.light.radiance_model import LightEvidence
from splatgraft.relighting.light.surroundings import DIRECTIONS, SOLID_ANGLE


@dataclass(frozen=True)
class RadianceSourceSettings:
    """What is a source; none of these numbers is sensitive."""

    over_median: float = 4.0
    """Luminance over the median of all directions."""
    least_share: float = 0.02
    """Of all light, from one direction."""
    most: int = 4
    """Sources."""
    radius: float = math.radians(14)
    """Radians around the brightest direction that belong to one source: its neighbours."""
    sun: float = 0.03
    """Steradians; a smaller clipped patch is called sun, a larger one window."""
    unseen_radius_deg: float = 1.0
    """Degrees: angular radius of a source that no camera saw, beside the uncertainty of its direction."""
    half_bin_deg: float = 4.0
    """Degrees: error of a direction that is known to one of `DIRECTIONS` alone."""
    clipped_error_deg: float = 2.0
    """Degrees: error of the middle of a clipped patch."""


def split_peaks(
    radiance: Float[Tensor, "k 3"],
    evidence: LightEvidence,
    *,
    within: float,
    settings: RadianceSourceSettings = RadianceSourceSettings(),
) -> tuple[tuple[LightSource, ...], Float[Tensor, "k 3"]]:
    """Cut the brightest directions out of the light as sources.

    Args:
        radiance: Linear rgb from all `DIRECTIONS`.
        evidence: At the place; it tells the directions and distances of visible sources.
        within: World units; occluders farther away do not block sources that no camera saw.
        settings: What is a source.

    Returns:
        The sources, brightest first, and the radiance without them.
    """
    luminance = radiance @ LUMINANCE
    is_peak = luminance > settings.over_median * luminance.median()
    is_peak &= luminance > settings.least_share * luminance.sum()
    near = math.cos(settings.radius) < DIRECTIONS @ DIRECTIONS.T
    left, rest, sources = is_peak.clone(), radiance.clone(), []
    while bool(left.any()) and len(sources) < settings.most:
        i = int((luminance * left).argmax())
        group, ring = near[i] & left, near[i] & ~is_peak
        left &= ~near[i]
        background = radiance[ring].mean(0) if bool(ring.any()) else radiance.median(0).values
        extra = (radiance[group] - background).clamp_min(0)
        sources.append(_source(group, extra, evidence, within=within, settings=settings))
        rest[group] = torch.minimum(rest[group], background)
    return tuple(sorted(sources, key=lambda source: -source.luminance)), rest


def ambient_of(rest: Float[Tensor, "k 3"]) -> Float[Tensor, "9 3"]:
    """Harmonics of degree 2 of radiance from all `DIRECTIONS`."""
    return fit_sh(DIRECTIONS, rest, torch.ones(len(DIRECTIONS)))


def _source(
    group: Bool[Tensor, "k"],
    extra: Float[Tensor, "p 3"],
    evidence: LightEvidence,
    *,
    within: float,
    settings: RadianceSourceSettings,
) -> LightSource:
    weight = extra @ LUMINANCE
    shares = evidence.visible_sources[group]
    visible = float(shares.sum())
    towards = evidence.around.clipped_direction[group] if visible > 0 else DIRECTIONS[group]
    direction = torch.nn.functional.normalize((weight[:, None] * towards).sum(0), dim=0)
    x, y, z = direction.tolist()
    r, g, b = (extra.sum(0) * SOLID_ANGLE).tolist()
    if visible > 0:
        size = max(visible, 0.1) * SOLID_ANGLE
        radius = angular_radius_deg(size)
        name = "sun" if size < settings.sun else "window"
        # a small patch may show the sun through a window; a large one stands where the panorama shows it
        distance = _distance(evidence.far.distance[group], weight * shares) if name == "window" else math.inf
        return LightSource(
            (x, y, z),
            (r, g, b),
            radius,
            settings.clipped_error_deg,
            name=name,
            distance=distance,
        )
    away = torch.rad2deg(torch.acos((towards @ direction).clamp(-1, 1)))
    spread = float((weight * away**2).sum() / weight.sum().clamp_min(1e-9)) ** 0.5
    error = math.hypot(spread, settings.half_bin_deg)
    return LightSource((x, y, z), (r, g, b), settings.unseen_radius_deg, error, 1.0, "sun", blockers_within=within)


def _distance(distances: Float[Tensor, "p"], weight: Float[Tensor, "p"]) -> float:
    """Their weighted harmonic mean."""
    nearness = float((weight / distances).sum() / weight.sum().clamp_min(1e-9))
    return 1 / nearness if nearness > 0 else math.inf
