"""Camera settings of photographs: exposure values, and differences between photographs.

Exposure values are at ISO 100: EV = log2(N^2 / t) - log2(ISO / 100).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

MAX_STOPS = 0.4
"""Largest range of exposures, stops, in a capture whose settings count as equal: one step of a camera's dial. This is a
third of a stop, up to 0.36 by the rounded numbers on the dial (1/160 s and 1/125 s)."""


@dataclass(frozen=True)
class Exposure:
    """Settings of one photograph; unknown ones are None."""

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
        """Exposure value at ISO 100, stops; one more doubles the luminance of white.

        Computed by shutter, aperture and ISO, or else by metered brightness and compensation.
        """
        if self.shutter_s is not None and self.aperture is not None and self.iso is not None:
            return math.log2(self.aperture**2 / self.shutter_s) - math.log2(self.iso / 100)
        if self.brightness_stops is not None:
            return self.brightness_stops + 5.0 - (self.bias_stops or 0.0)  # APEX: 5 is the speed value of ISO 100
        return None

    def __str__(self) -> str:
        """Write the settings in photographers' notation, such as '1/60 s f/1.8 ISO 100'."""
        if self.shutter_s is None or self.aperture is None or self.iso is None:
            return "unknown settings" if self.ev100 is None else f"EV {self.ev100:.1f}"
        short = self.shutter_s < 0.4
        shutter = f"1/{1 / self.shutter_s:.0f}" if short else f"{self.shutter_s:.2g}"
        return f"{shutter} s f/{self.aperture:.2g} ISO {self.iso:.0f}"


def relative_gains(exposures: Sequence[Exposure]) -> list[float]:
    """Compute the brightness of each photo's sRGB values over the mean photo's, by its settings; 1 if unknown.

    A factor on linear light is its 2.2th root in sRGB, before a camera's tone curve.
    """
    stops = [one.ev100 for one in exposures if one.ev100 is not None]
    middle = sum(stops) / max(len(stops), 1)
    gains = [1.0 if one.ev100 is None else 2 ** ((middle - one.ev100) / 2.2) for one in exposures]
    return [gain * len(gains) / sum(gains) for gain in gains]


def describe_inconsistency(exposures: Sequence[Exposure]) -> str | None:
    """Describe differing settings of photos and their effect, in one line; None if none differ."""
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
