"""Camera settings of photographs, and the luminance that linear pixel values stand for under them.

Exposure values are at ISO 100: EV = log2(N^2 / t) - log2(ISO / 100). A pixel saturates at 1.2 * 2^EV cd/m2, from a
saturation-based speed of 78 / H (ISO 12232) and a lens that passes 0.65 of the light.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

_SATURATION_CD_M2 = 78 / (100 * 0.65)  # luminance of white at EV 0 and ISO 100
_EV_OF_BRIGHTNESS_0 = 5.0  # APEX: the speed value of ISO 100
_GAMMA = 2.2
MAX_STOPS = 0.4
"""Between the darkest and the brightest setting of a capture's photos, above which settings count as different: a third
of a stop, one step of a camera's dial, which with the rounded numbers on it is up to 0.36 (1/160 s and 1/125 s)."""


@dataclass(frozen=True)
class Exposure:
    """Settings of one photograph as its file tells them, each None where it does not."""

    shutter_s: float | None = None
    """Exposure time, seconds, above 0."""
    aperture: float | None = None
    """f-number, above 0."""
    iso: float | None = None
    """Sensitivity, above 0."""
    bias_stops: float | None = None
    """Exposure compensation; positive is brighter than metered."""
    brightness_stops: float | None = None
    """Metered luminance of the scene, the brightness value of APEX."""
    auto_white_balance: bool | None = None
    """Whether the camera chose the white balance."""

    @property
    def ev100(self) -> float | None:
        """Exposure value at ISO 100, stops: one more means that white is twice the luminance.

        From shutter, aperture and ISO; where one is missing, from the metered brightness and the compensation.
        """
        if self.shutter_s is not None and self.aperture is not None and self.iso is not None:
            return math.log2(self.aperture**2 / self.shutter_s) - math.log2(self.iso / 100)
        if self.brightness_stops is not None:
            return self.brightness_stops + _EV_OF_BRIGHTNESS_0 - (self.bias_stops or 0.0)
        return None

    def __str__(self) -> str:
        """The settings as photographers write them, such as '1/60 s f/1.8 ISO 100'."""
        if self.shutter_s is None or self.aperture is None or self.iso is None:
            return "unknown settings" if self.ev100 is None else f"EV {self.ev100:.1f}"
        short = self.shutter_s < 0.4
        shutter = f"1/{1 / self.shutter_s:.0f}" if short else f"{self.shutter_s:.2g}"
        return f"{shutter} s f/{self.aperture:.2g} ISO {self.iso:.0f}"


def relative_gains(exposures: Sequence[Exposure]) -> list[float]:
    """How much brighter each photo's sRGB values are than the mean photo's, by its settings; 1 where they are unknown.

    A factor on linear light is its 2.2th root in sRGB, before a camera's tone curve.
    """
    stops = [one.ev100 for one in exposures if one.ev100 is not None]
    middle = sum(stops) / max(len(stops), 1)
    gains = [1.0 if one.ev100 is None else 2 ** ((middle - one.ev100) / _GAMMA) for one in exposures]
    return [gain * len(gains) / sum(gains) for gain in gains]


@dataclass(frozen=True)
class LuminanceScale:
    """Absolute luminance of a capture's linear values, cd/m2; right to about a stop, as cameras' speeds differ."""

    white: float
    """Luminance that the linear value 1 stands for in the median photo."""
    mean: float
    """Mean luminance of what the photos show, the median over photos."""


def luminance_scale(exposures: Sequence[Exposure], means: Sequence[float]) -> LuminanceScale | None:
    """The luminance behind a capture's linear values; None where under half of the photos have exposure data.

    `means`: mean linear luminance of each photo's pixels, in [0, 1].
    """
    whites = [None if one.ev100 is None else _SATURATION_CD_M2 * 2**one.ev100 for one in exposures]
    known = [(white, mean) for white, mean in zip(whites, means, strict=True) if white is not None]
    if not known or 2 * len(known) < len(exposures):
        return None
    return LuminanceScale(median(white for white, _ in known), median(white * mean for white, mean in known))


def describe_inconsistency(exposures: Sequence[Exposure]) -> str | None:
    """What differs between the settings of photos and what that leads to, in one line; None where nothing does."""
    known = sorted((value, str(one)) for one in exposures if (value := one.ev100) is not None)
    stops = known[-1][0] - known[0][0] if known else 0.0
    found: list[str] = []
    if stops > MAX_STOPS:
        found.append(f"exposures from {known[-1][1]} to {known[0][1]}, {stops:.1f} stops apart")
    if automatic := sum(one.auto_white_balance is True for one in exposures):
        of = "" if automatic == len(exposures) else f" in {automatic} of {len(exposures)} photos"
        found.append(f"automatic white balance{of}")
    if not found:
        return None
    return (
        f"brightness or colour changes from photo to photo, which can leave fog and patches of colour: expected one "
        f"exposure and one white balance, found {' and '.join(found)}; lock both when capturing"
    )
