"""The sun where it is known that there is one: by the clock of the photos, or out of doors.

Out of doors the sun is known by a clear sky, whose brightness shows where it stands (`sky.py`), or as the brightest
source that no camera saw. The log densities of clock, sky and source are added.

Clouds or walls may still hide the sun. So the sun's strength, its irradiance on level ground over that of
all other light, has a posterior:

- The likelihood is that of the shading and the highlights (`radiance_model.py`), for one source over the light that the
  estimate has beside its sources. If the edge of a shadow was measured, its likelihood is a factor.
- The prior is a mixture. Under a clear sky the strength is known from the sun's height; otherwise every share of all
  light up to that is as likely.

The estimate is the median. The maximum would be a clear sky's strength wherever the likelihood says nothing.

A tree that no view shows may shade a place from a sun that shines beside it. The ground around the place tells
(`OpenGround`).
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.clock_sun import ClockSun, clock_directions
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.light import LightSource
from splatgraft.relighting.light.panorama import DIRECTIONS
from splatgraft.relighting.light.radiance_model import LightEvidence, RadianceProblem
from splatgraft.relighting.light.radiance_search import source_costs
from splatgraft.relighting.light.sky import SkyEvidence, suns_above
from splatgraft.relighting.light.sun import (
    ERROR_DEG,
    LOWEST_SINE,
    SURFACES,
    Sun,
    draw_surface,
    find_surfaces,
    prior_near,
    standing_on,
)

# a clear sky, fitted by benchmarks/fit_sky.py
_CLEAR = 11.2  # strength of the sun over the sine of its height
_CLEAR_SD = 0.26  # standard deviation of the logarithm of that
_TINT = (1.34, 0.97, 0.58)  # strength in red, green and blue over that in luminance

# the edge of a shadow, fitted by benchmarks/fit_sun.py
_SHADE_IS_BRIGHTER, _SHADE_IS_DARKER = 0.1, 0.04
"""Mean errors of the brightness of shade over that of lit ground. Gaussians mix both, so shade looks brighter."""

# set by hand
_IS_CLEAR, _SEEN_IS_CLEAR = 0.5, 0.9  # probability of a clear sky if the views do not show one, and if they do
_SHADING_IS_WRONG = 0.3  # probability that the brightest source is not the sun, beside other evidence
_STRENGTHS = torch.logspace(-2, 1.4, 35, dtype=torch.float64)
_LEAST = 0.1  # strength below which the sun is hidden
_SUN_RADIUS_DEG = 0.27

# a shade that nothing captured casts; set by hand
_AT_PLACE = 1.5  # object radii from the object's middle within which ground is at its place
_FEWEST = 8  # texels of that ground
_IS_OPEN = 0.9  # share of the sun's light that passes the captured things; ground with less is in their shade
_MAX_GREEN = 0.15  # largest difference of log(green / sqrt(red blue)) within one material
_SUNLIT = 0.03  # share of sunlit ground that shows a shade: 17 places outdoors have 0 in the sun, .06 in a shade

BY_CLOCK = "sun by the photos' clock"
"""Name in reports."""


@dataclass(frozen=True)
class KnownSun:
    """A sun that exists unless clouds or walls hide it."""

    directions: Float[Tensor, "k 3"]
    """Unit directions above the horizon."""
    log_density: Float[Tensor, "k"]
    """Log density of the sun's direction at each of `directions`."""
    name: str
    """Name in reports."""


def known_sun(
    captured: CapturedScene, main: LightSource | None, sky: SkyEvidence | None, *, outdoors: bool, is_unseen: bool
) -> KnownSun | None:
    """Find out whether there is a sun unless something hides it, and where it may stand.

    Args:
        captured: The scene.
        main: Brightest estimated source.
        sky: A clear sky; None if the views do not show one.
        outdoors: Whether the scene is out of doors.
        is_unseen: Whether no camera saw `main`, so that it may be the sun.
    """
    directions = suns_above(captured.up)
    log_density = torch.zeros(len(directions)) if sky is None else sky.log_density(directions)
    clock = captured.clock if len(clock_directions(captured.clock)) else None
    if main is not None and (math.isfinite(main.distance) or (clock is None and not (outdoors and is_unseen))):
        main = None  # it cannot be the sun
    if clock is None and sky is None and main is None:
        return None
    if clock is not None:
        log_density = log_density + _by_clock(directions, clock)
    if main is not None:
        wrong = 0.0 if clock is None and sky is None else _SHADING_IS_WRONG
        towards = torch.tensor([main.direction])
        log_density = log_density + prior_near(towards, main.uncertainty_deg, wrong=wrong)(directions)
    return KnownSun(directions, log_density, "sun" if clock is None else BY_CLOCK)


def _by_clock(directions: Float[Tensor, "k 3"], clock: ClockSun) -> Float[Tensor, "k"]:
    """Compute the log density of the clock's most trusted candidate, up to a constant."""
    up, sun = torch.tensor(clock.up), clock_directions(clock)[0]
    height_error = max(clock.height_error_deg, ERROR_DEG)
    level_error = max(math.sqrt(max(clock.error_deg**2 - clock.height_error_deg**2, 0.0)), ERROR_DEG)
    sines, sine = (directions @ up).clamp(-1, 1), (sun @ up).clamp(-1, 1)
    level, level_sun = directions - sines[:, None] * up, sun - sine * up
    turned = torch.atan2(torch.linalg.cross(level_sun.expand_as(level), level) @ up, level @ level_sun)
    higher_deg, aside_deg = torch.rad2deg(sines.asin() - sine.asin()), torch.rad2deg(turned) * level_sun.norm()
    return -0.5 * ((higher_deg / height_error).square() + (aside_deg / level_error).square())


def clear_ratio(sine: float) -> Float[Tensor, "3"]:
    """Return the most probable irradiance of the sun over that of all other light, under a clear sky.

    Args:
        sine: Sine of the sun's height.
    """
    return _CLEAR * max(sine, LOWEST_SINE) * torch.tensor(_TINT)


def sun_towards(
    sun: Sun, sky: SkyEvidence | None, problem: RadianceProblem, evidence: LightEvidence, rest: Float[Tensor, "k 3"]
) -> Sun | None:
    """Estimate the strength of a sun in a known direction.

    Args:
        sun: The sun. Its ratio is that of a shadow's edge; None if none was measured.
        sky: A clear sky; None if the views do not show one.
        problem: Density of the light at the place.
        evidence: Evidence that `problem` is made of.
        rest: Estimated radiance from all `DIRECTIONS` without the sources.

    Returns:
        The sun with its ratio; None if the evidence is against a sun there.
    """
    log_posterior = _log_prior(float(sun.direction @ evidence.up), _IS_CLEAR if sky is None else _SEEN_IS_CLEAR)
    gray, sines = rest.mean(1).double(), (DIRECTIONS @ evidence.up).clamp_min(0).double()
    # radiance of one direction that gives the sun's irradiance on level ground
    added = _STRENGTHS * (sines @ gray) / max(float(sun.direction @ evidence.up), LOWEST_SINE)
    log_posterior -= source_costs(problem, evidence, gray, sun.direction, added) / problem.settings.temperature
    radius_deg, tint = _SUN_RADIUS_DEG, torch.tensor(_TINT)
    if sun.ratio is not None:
        measured = float(sun.ratio @ LUMINANCE)
        log_posterior += _edge_log_likelihood(measured)
        radius_deg, tint = sun.radius_deg, sun.ratio / measured
    median = int((log_posterior.softmax(0).cumsum(0) < 0.5).sum())
    strength = float(_STRENGTHS[median])
    return None if strength < _LEAST else replace(sun, radius_deg=radius_deg, ratio=strength * tint)


def _edge_log_likelihood(measured: float) -> Float[Tensor, "r"]:
    """Compute the log likelihood of each of `_STRENGTHS`, up to a constant, if a shadow's edge shows `measured`."""
    brighter = 1 / (1 + measured) - 1 / (1 + _STRENGTHS)  # shade over lit ground, less the true one
    return torch.where(brighter > 0, -brighter / _SHADE_IS_BRIGHTER, brighter / _SHADE_IS_DARKER)


@dataclass(frozen=True)
class OpenGround:
    """m texels of level ground, not in the shade of captured things.

    Sunlight makes ground several times brighter, and redder. So a place is in the shade of something that was not
    captured if some ground of the same material around it is brighter and redder by a clear sky's sun.
    """

    points: Float[Tensor, "m 3"]
    """World units."""
    tones: Float[Tensor, "m 3"]
    """As of `_tones`."""
    sunlight: Float[Tensor, "2"]
    """Change of the first two tones from shade to a clear sky's sun."""

    @staticmethod
    def around(captured: CapturedScene, region: BoundingSphere, sun: Sun) -> "OpenGround":
        """Collect the ground of a region.

        Args:
            captured: The scene with all objects that cast shadows during the capture.
            region: Sphere around the place.
            sun: The sun; its strength is not read.
        """
        points, found = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
        for surface in find_surfaces(captured, region, most=SURFACES):
            picture, standing = draw_surface(captured, surface), standing_on(surface, captured.gaussians, region)
            is_open = picture.valid & (surface.shadows(standing, sun.direction[None])[0] > _IS_OPEN)
            points.append(surface.texels()[is_open])
            found.append(_tones(picture.log_rgb[is_open]))
        lit_over_shaded = 1 + clear_ratio(float(sun.direction @ captured.up))
        return OpenGround(torch.cat(points), torch.cat(found), _tones(lit_over_shaded.log())[:2])

    def is_shaded(self, place: BoundingSphere) -> bool:
        """Return whether the ground at an object's place is in the shade of something that was not captured.

        Args:
            place: The object's bounding sphere.
        """
        at_place = (self.points - place.center).norm(dim=1) < _AT_PLACE * place.radius
        if int(at_place.sum()) < _FEWEST:
            return False
        away = self.tones - self.tones[at_place].median(0).values
        is_same_material = away[:, 2].abs() < _MAX_GREEN
        is_sunlit = (away[:, :2] / self.sunlight - 1).abs().amax(1) < 0.5  # nearer to sunlit ground than to the place
        return float(is_sunlit[is_same_material].float().mean()) > _SUNLIT


def _tones(log_rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Return logarithms of luminance, of red over blue, and of green over the geometric mean of red and blue.

    Args:
        log_rgb: Logarithm of linear rgb.
    """
    red, green, blue = log_rgb.unbind(-1)
    return torch.stack([(log_rgb.exp() @ LUMINANCE).log(), red - blue, green - 0.5 * (red + blue)], -1)


def _log_prior(sine: float, is_clear: float) -> Float[Tensor, "r"]:
    """Return the log prior of `_STRENGTHS` for a sun whose height has this sine, and a probability of a clear sky."""
    clear = _CLEAR * max(sine, LOWEST_SINE)
    of_clear = torch.exp(-0.5 * ((_STRENGTHS / clear).log() / _CLEAR_SD) ** 2)
    weaker = (clear >= _STRENGTHS) * _STRENGTHS / (1 + _STRENGTHS).square()  # an even density of the sun's share
    return (is_clear * of_clear / of_clear.sum() + (1 - is_clear) * weaker / weaker.sum() + 1e-12).log()
