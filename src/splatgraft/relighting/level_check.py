"""A check on the level of a light transfer: the estimated change of illuminance beside that of the photos' luminance.

Exposure metadata gives both captures absolute units. The ratio that is applied to the object is in each capture's own
units and does not depend on it.
"""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.exposure import LuminanceScale
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.layers import Relit


@dataclass(frozen=True)
class LevelCheckSettings:
    """When an estimated level is said to be doubtful; set by hand."""

    most_difference: float = 1.5
    """Stops. The mean reflectance of what a capture shows is mostly from 0.1 to 0.5: of two, at most about 2.3 stops
    apart, and seldom more than this."""
    most_lux: float = 200_000.0
    """Sun and clear sky give up to 130,000; the rest is the error of cameras' speeds."""


@dataclass(frozen=True)
class LevelLine:
    """What the photos' exposure says of the level of the light on one object."""

    text: str
    """One line."""
    is_doubtful: bool
    """Whether the estimated level does not agree with the photos, or is more than there is under the sun."""


def describe_level(
    relit: Relit,
    *,
    target: LuminanceScale,
    source: LuminanceScale,
    settings: LevelCheckSettings = LevelCheckSettings(),
) -> tuple[LevelLine, ...]:
    """Compare how much brighter the new place is by the photos and by the light on each object, before any share.

    Args:
        relit: A transfer.
        target: Of the target's photos.
        source: Of the photos that all objects of known source light come from.
        settings: What is doubtful.

    Returns:
        One line per object of known source light; none where a photo shows no light.
    """
    if min(target.mean, source.mean) <= 0:
        return ()
    lines: list[LevelLine] = []
    for i, (prepared, received) in enumerate(zip(relit.prepared, relit.received, strict=True), 1):
        if prepared.source_lighting is None:
            continue
        weights = prepared.gaussians.opacities
        new = target.white * _mean_luminance(received, weights)
        old = source.white * _mean_luminance(prepared.source_lighting.irradiance, weights)
        if min(new, old) > 0:
            lines.append(_line(i, math.log2(target.mean / source.mean), (new, old), settings))
    return tuple(lines)


def _line(number: int, by_photos: float, lux: tuple[float, float], settings: LevelCheckSettings) -> LevelLine:
    new, old = lux
    by_light = math.log2(new / old)
    plain = (
        f"Object {number}: by the exposure of the photos the new place is {_brighter(by_photos)} than the old one, by "
        f"the light on the object {_brighter(by_light)} ({_rounded(new)} lux there, {_rounded(old)} at the old place)."
    )
    doubts = ""
    if abs(by_light - by_photos) > settings.most_difference:
        doubts += (
            f" They differ by {abs(by_light - by_photos):.1f} stops: one of the lights may be wrong, or what the "
            f"photos of the two places show differs as much in reflectance."
        )
    if max(lux) > settings.most_lux:
        doubts += " That is more than sun and sky give: the estimated light is too strong, or the metadata is wrong."
    return LevelLine(plain + doubts, bool(doubts))


def _mean_luminance(irradiance: Float[Tensor, "n 3"], weights: Float[Tensor, "n"]) -> float:
    mean = (weights[:, None] * irradiance).sum(0) / weights.sum().clamp_min(1e-9)
    return float(mean @ LUMINANCE)


def _brighter(stops: float) -> str:
    return f"{abs(stops):.1f} stops {'brighter' if stops >= 0 else 'darker'}"


def _rounded(lux: float) -> str:
    """Two digits: no camera is calibrated better."""
    return f"{float(f'{lux:.2g}'):,.6g}"
