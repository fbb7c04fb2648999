"""Confidence in a light as one number, from its coverage and the uncertainty of its sources."""

import math

from splatgraft.relighting.light.light import Light

_C0 = 0.28209479
"""Of the harmonics' first band; rounded, and kept so: `core.spherical_harmonics.C0` would change written priors."""
_UNCERTAIN_DEG = 20.0
"""Degrees of direction uncertainty at which a source counts exp(-1); set by hand."""


def light_confidence(light: Light) -> float:
    """Share of the light, in [0, 1], that was captured and whose direction is certain.

    A source counts by exp(-(uncertainty / 20 degrees)^2) times its confidence, ambient light fully; the sum is scaled
    by the coverage of the surroundings.
    """
    ambient = math.pi * float(light.ambient[0].mean()) * _C0
    total, certain = ambient, ambient
    for source in light.sources:
        total += source.luminance
        certain += source.luminance * source.confidence * math.exp(-((source.uncertainty_deg / _UNCERTAIN_DEG) ** 2))
    return light.coverage * certain / total if total > 0 else 0.0
