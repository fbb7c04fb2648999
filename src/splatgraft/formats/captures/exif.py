"""Exposure metadata of photographs: from EXIF tags to `Exposure`, and back to the tags of a written image."""

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from splatgraft.core.exposure import Exposure
from splatgraft.core.images import read_exif

_ISO_BEYOND_16_BITS = 65535
"""Value of PhotographicSensitivity that refers to the other tags."""
_AUTO, _MANUAL = 0, 1
"""Values of the tag WhiteBalance."""
_MOST_STOPS = 40.0
"""Of any APEX value; cameras write some 100 stops where they know nothing."""


def read_exposure(path: Path) -> Exposure:
    """Read the exposure metadata of a photo.

    Tags that are missing, zero, not finite or not numbers count as not known. Where a camera wrote only APEX values,
    shutter and aperture follow from them.

    Args:
        path: An image file; JPEG, PNG, WebP and TIFF can have EXIF.

    Raises:
        ValueError: The file is no readable image.
    """
    tags = read_exif(path)
    balance = _number(tags.get(Base.WhiteBalance))
    return Exposure(
        shutter_s=_positive(tags, Base.ExposureTime) or _from_apex(tags, Base.ShutterSpeedValue, lambda tv: 2**-tv),
        aperture=_positive(tags, Base.FNumber) or _from_apex(tags, Base.ApertureValue, lambda av: 2 ** (av / 2)),
        iso=_iso(tags),
        bias_stops=_stops(tags, Base.ExposureBiasValue),
        brightness_stops=_stops(tags, Base.BrightnessValue),
        auto_white_balance=balance == _AUTO if balance in (_AUTO, _MANUAL) else None,
    )


def exif_of(exposure: Exposure) -> Image.Exif:
    """The EXIF with the known settings and nothing else, for Pillow's `save` of a JPEG."""
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
        large = exposure.iso >= _ISO_BEYOND_16_BITS
        tags[Base.ISOSpeedRatings] = _ISO_BEYOND_16_BITS if large else round(exposure.iso)
        if large:
            tags[Base.RecommendedExposureIndex] = round(exposure.iso)
    if exposure.auto_white_balance is not None:
        tags[Base.WhiteBalance] = _AUTO if exposure.auto_white_balance else _MANUAL
    return exif


def _iso(tags: Mapping[int, Any]) -> float | None:
    iso = _positive(tags, Base.ISOSpeedRatings)
    if iso is not None and iso != _ISO_BEYOND_16_BITS:
        return iso
    return _positive(tags, Base.RecommendedExposureIndex) or _positive(tags, Base.ISOSpeed)


def _from_apex(tags: Mapping[int, Any], tag: int, value_of: Callable[[float], float]) -> float | None:
    stops = _stops(tags, tag)
    return None if stops is None else value_of(stops)


def _stops(tags: Mapping[int, Any], tag: int) -> float | None:
    value = _number(tags.get(tag))
    return None if value is None or abs(value) > _MOST_STOPS else value


def _positive(tags: Mapping[int, Any], tag: int) -> float | None:
    value = _number(tags.get(tag))
    return None if value is None or value <= 0 else value


def _number(value: object) -> float | None:
    """A tag's value as a finite number, the first of several; None where it is none."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        value = value[0] if value else None
    if not isinstance(value, int | float | IFDRational):
        return None
    try:
        number = float(value)
    except (ArithmeticError, ValueError):
        return None
    return number if math.isfinite(number) else None
