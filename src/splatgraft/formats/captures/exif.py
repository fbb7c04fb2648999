"""Exposure metadata of photographs: EXIF tags to `Exposure`, and back for a written image."""

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from splatgraft.core.exposure import Exposure
from splatgraft.core.images import read_exif

_AUTO, _MANUAL = 0, 1
"""Values of the tag WhiteBalance."""
_MAX_STOPS = 40.0  # largest APEX value; cameras write about 100 for unknown ones


def read_exposure(path: Path) -> Exposure:
    """Read the exposure metadata of a photo; tags that are missing, zero or not finite count as unknown."""
    numbers = {tag: _number(value) for tag, value in read_exif(path).items()}
    positive = {tag: number for tag, number in numbers.items() if number is not None and number > 0}
    stops = {tag: number for tag, number in numbers.items() if number is not None and abs(number) <= _MAX_STOPS}
    balance = numbers.get(Base.WhiteBalance)
    return Exposure(
        shutter_s=positive.get(Base.ExposureTime),
        aperture=positive.get(Base.FNumber),
        iso=positive.get(Base.ISOSpeedRatings),
        bias_stops=stops.get(Base.ExposureBiasValue),
        brightness_stops=stops.get(Base.BrightnessValue),
        auto_white_balance=balance == _AUTO if balance in (_AUTO, _MANUAL) else None,
    )


def exif_of(exposure: Exposure) -> Image.Exif:
    """Make EXIF of the known settings alone, for Pillow's `save` of a JPEG."""
    rationals = {
        Base.ExposureTime: exposure.shutter_s,
        Base.FNumber: exposure.aperture,
        Base.ExposureBiasValue: exposure.bias_stops,
        Base.BrightnessValue: exposure.brightness_stops,
    }
    exif = Image.Exif()
    tags = exif.get_ifd(IFD.Exif)
    for tag, value in rationals.items():
        if value is not None:
            fraction = Fraction(value).limit_denominator(1_000_000)
            tags[tag] = IFDRational(fraction.numerator, fraction.denominator)
    if exposure.iso is not None:
        tags[Base.ISOSpeedRatings] = min(round(exposure.iso), 65535)  # the tag has 16 bits
    if exposure.auto_white_balance is not None:
        tags[Base.WhiteBalance] = _AUTO if exposure.auto_white_balance else _MANUAL
    return exif


def _number(value: object) -> float | None:
    """Convert a tag's value, or the first of several, to a finite number; None if it is none."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        value = value[0] if value else None
    if not isinstance(value, int | float | IFDRational):
        return None
    try:
        number = float(value)
    except (ArithmeticError, ValueError):
        return None
    return number if math.isfinite(number) else None
