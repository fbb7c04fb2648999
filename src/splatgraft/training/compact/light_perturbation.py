"""Lights made wrong on purpose, as an estimate would be, with a doubt that is honest on the average. Knows no pixels.

The ranges: directions off by up to 30 degrees, strength by a factor of up to four either way, level and tint besides.
"""

import math
import random
from dataclasses import replace

import torch

from splatgraft.relighting.light.light import Light, LightSource

_FARTHEST_DEG = 30.0
_STRONGEST = 4.0
_MISSED = 0.05


def perturb_light(light: Light, rng: random.Random) -> Light:
    """`light` as somebody might have estimated it; `uncertainty_deg` tells the spread that the error was drawn from."""
    spread = rng.uniform(0.0, 20.0)
    level = math.exp(max(-1.4, min(1.4, rng.gauss(0.0, 0.35))))
    tint = [math.exp(rng.gauss(0.0, 0.06)) for _ in range(3)]
    strength = math.exp(max(-1.0, min(1.0, rng.gauss(0.0, 0.45))) * math.log(_STRONGEST))
    sources = [
        _turned(source, rng, spread, [level * strength * t for t in tint])
        for source in light.sources
        if rng.random() > _MISSED
    ]
    coverage = rng.uniform(0.45, 1.0)
    factor = level * torch.tensor(tint)
    return Light(tuple(sources), ambient=light.ambient * factor, coverage=coverage, unseen_up=1 - coverage)


def _turned(source: LightSource, rng: random.Random, spread: float, factor: list[float]) -> LightSource:
    angle = math.radians(min(_FARTHEST_DEG, abs(rng.gauss(0.0, spread))))
    around = rng.uniform(0.0, 2 * math.pi)
    direction = torch.tensor(source.direction)
    helper = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
    side = torch.nn.functional.normalize(torch.linalg.cross(direction, helper), dim=0)
    other = torch.linalg.cross(direction, side)
    aside = math.cos(around) * side + math.sin(around) * other
    x, y, z = (math.cos(angle) * direction + math.sin(angle) * aside).tolist()
    r, g, b = (value * f for value, f in zip(source.irradiance, factor, strict=True))
    return replace(
        source,
        direction=(x, y, z),
        irradiance=(r, g, b),
        uncertainty_deg=2.0 + spread * rng.uniform(0.7, 1.3),
        confidence=rng.uniform(0.6, 1.0),
    )
