"""Random perturbation of known lights, as a model of the errors of an estimated light.

The recorded uncertainty is that of the distribution from which the error in direction was drawn, times a random factor.
"""

import math
import random
from dataclasses import dataclass, replace

import torch

from splatgraft.relighting.light.light import Light, LightSource


@dataclass(frozen=True)
class LightPerturbation:
    """Distributions of the errors, set by hand. A log error of x is a factor of e^x."""

    max_spread_deg: float = 20.0
    """The standard deviation of the error in direction is drawn from 0 up to this."""
    max_angle_deg: float = 30.0
    """Largest error in direction."""
    level_deviation: float = 0.35
    """Standard deviation of the log error of the light's overall level."""
    max_level: float = 1.4
    """Largest log error of the level."""
    tint_deviation: float = 0.06
    """Standard deviation of the log error of each colour channel."""
    max_strength_factor: float = 4.0
    """Largest factor between sources and ambient light, either way."""
    strength_deviation: float = 0.45
    """Standard deviation of the log error of the sources, in units of the log of `max_strength_factor`."""
    missed_share: float = 0.05
    """Probability that a source is missed."""
    coverage: tuple[float, float] = (0.45, 1.0)
    """Range of the coverage of the surroundings."""
    confidence: tuple[float, float] = (0.6, 1.0)
    """Range of a source's confidence."""
    uncertainty_offset_deg: float = 2.0
    """Added to every source's uncertainty."""
    uncertainty_factor: tuple[float, float] = (0.7, 1.3)
    """Range of the recorded uncertainty over the true spread."""


def perturb_light(light: Light, rng: random.Random, settings: LightPerturbation = LightPerturbation()) -> Light:
    """Draw a perturbed copy of `light`, with the uncertainty and confidence that an estimate would report."""
    spread = rng.uniform(0.0, settings.max_spread_deg)
    max_level = settings.max_level
    level = math.exp(max(-max_level, min(max_level, rng.gauss(0.0, settings.level_deviation))))
    tint = [math.exp(rng.gauss(0.0, settings.tint_deviation)) for _ in range(3)]
    log_strength = max(-1.0, min(1.0, rng.gauss(0.0, settings.strength_deviation)))
    strength = math.exp(log_strength * math.log(settings.max_strength_factor))
    factor = [level * strength * t for t in tint]
    sources = [
        _perturb_source(source, rng, spread, factor=factor, settings=settings)
        for source in light.sources
        if rng.random() > settings.missed_share
    ]
    coverage = rng.uniform(*settings.coverage)
    return Light(
        tuple(sources),
        ambient=light.ambient * (level * torch.tensor(tint)),
        coverage=coverage,
        unseen_up=1 - coverage,
    )


def _perturb_source(
    source: LightSource, rng: random.Random, spread: float, *, factor: list[float], settings: LightPerturbation
) -> LightSource:
    angle = math.radians(min(settings.max_angle_deg, abs(rng.gauss(0.0, spread))))
    azimuth = rng.uniform(0.0, 2 * math.pi)
    direction = torch.tensor(source.direction)
    helper = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
    tangent = torch.nn.functional.normalize(torch.linalg.cross(direction, helper), dim=0)
    bitangent = torch.linalg.cross(direction, tangent)
    offset = math.cos(azimuth) * tangent + math.sin(azimuth) * bitangent
    x, y, z = (math.cos(angle) * direction + math.sin(angle) * offset).tolist()
    r, g, b = (value * f for value, f in zip(source.irradiance, factor, strict=True))
    return replace(
        source,
        direction=(x, y, z),
        irradiance=(r, g, b),
        uncertainty_deg=settings.uncertainty_offset_deg + spread * rng.uniform(*settings.uncertainty_factor),
        confidence=rng.uniform(*settings.confidence),
    )
