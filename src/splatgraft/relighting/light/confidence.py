"""One number for how far a light may be believed. Knows nothing about how it was found."""

import math

from splatgraft.relighting.light.light import Light

_HALF_DEG = 20.0


def light_confidence(light: Light) -> float:
    """Share of the light, in [0, 1], that was seen and whose direction is sure.

    Of every source the part exp(-(uncertainty / 20 degrees)^2) times its confidence counts; all of the ambient light
    does; what was not seen does not.
    """
    ambient = math.pi * float(light.ambient[0].mean()) * 0.28209479
    total, sure = ambient, ambient
    for source in light.sources:
        total += source.luminance
        sure += source.luminance * source.confidence * math.exp(-((source.uncertainty_deg / _HALF_DEG) ** 2))
    return light.coverage * sure / total if total > 0 else 0.0
