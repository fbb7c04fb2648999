"""Metadata of photographs: EXIF tags to `Exposure` and `Geotag`, and exposure back for a written image."""

import math
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from splatgraft.core.clock_sun import Geotag
from splatgraft.core.exposure import Exposure
from splatgraft.core.images import read_exif

_Value = TypeVar("_Value")
_AUTO, _MANUAL = 0, 1
"""Values of the tag WhiteBalance."""
_MAX_STOPS = 40.0  # largest APEX value; cameras write about 100 for unknown ones
_BLANK = ("0000", " ", ":", "\0")  # beginnings of an unknown date or time
_FIRST_YEAR = 1990  # earlier dates are those of a clock that was never set
_MAX_OFFSET = timedelta(hours=14)  # Kiribati


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


def read_geotag(path: Path) -> Geotag:
    """Read time, place and compass of a photo; tags with impossible values count as missing, and are named."""
    gps, camera = read_exif(path, part=IFD.GPSInfo), read_exif(path)
    broken: list[str] = []

    def read(name: str, parse: Callable[..., _Value], *values: Any) -> _Value | None:
        """Parse tags; None if one of them is missing or blank."""
        if any(value is None or value == "" or str(value).startswith(_BLANK) for value in values):
            return None
        try:
            return parse(*values)
        except (ValueError, TypeError, ArithmeticError, IndexError):
            broken.append(name)
            return None

    place = None
    if gps.get(GPS.GPSStatus) != "V":  # void: the receiver had no fix
        degrees = (gps.get(tag) for tag in (GPS.GPSLatitude, GPS.GPSLatitudeRef, GPS.GPSLongitude, GPS.GPSLongitudeRef))
        place = read("GPSLatitude, GPSLongitude", _place, *degrees)
    altitude = read("GPSAltitude", _finite, gps.get(GPS.GPSAltitude))
    below_sea = altitude is not None and gps.get(GPS.GPSAltitudeRef) in (b"\x01", 1)
    return Geotag(
        gps_time=read("GPSDateStamp, GPSTimeStamp", _gps_time, gps.get(GPS.GPSDateStamp), gps.get(GPS.GPSTimeStamp)),
        camera_time=read("DateTimeOriginal", _camera_time, camera.get(Base.DateTimeOriginal)),
        camera_offset=read("OffsetTimeOriginal", _offset, camera.get(Base.OffsetTimeOriginal)),
        # latitude and longitude 0 mean an unknown place
        position=(*place, -altitude if altitude and below_sea else altitude) if place and any(place) else None,
        heading_deg=read("GPSImgDirection", lambda value: _within(value, 0, 360), gps.get(GPS.GPSImgDirection)),
        heading_is_true=gps.get(GPS.GPSImgDirectionRef) == "T",
        broken=tuple(broken),
    )


def _gps_time(date: str, time: Sequence[Any]) -> datetime:
    year, month, day = map(int, re.findall(r"\d+", date)[:3])
    hour, minute, second = (_within(value, 0, limit) for value, limit in zip(time, (23, 59, 60), strict=True))
    return _plausible(datetime(year, month, day, tzinfo=UTC)) + timedelta(hours=hour, minutes=minute, seconds=second)


def _camera_time(text: str) -> datetime:
    year, month, day, hour, minute, second = map(int, re.findall(r"\d+", text)[:6])
    return _plausible(datetime(year, month, day, hour, minute, min(second, 59)))


def _plausible(time: datetime) -> datetime:
    if time.year < _FIRST_YEAR:
        raise ValueError(f"expected a year from {_FIRST_YEAR}, found {time.year}")
    return time


def _offset(text: str) -> timedelta:
    found = re.fullmatch(r"([+-])(\d\d):?(\d\d)", text.strip(" \0"))
    if found is None:
        raise ValueError(f"expected an offset such as +09:00, found {text}")
    size = timedelta(hours=int(found[2]), minutes=int(found[3]))
    if size > _MAX_OFFSET:
        raise ValueError(f"expected an offset of at most {_MAX_OFFSET}, found {text}")
    return -size if found[1] == "-" else size


def _place(latitude: Any, north: str, longitude: Any, east: str) -> tuple[float, float]:
    signs = {"N": 1, "S": -1, "E": 1, "W": -1}
    sizes = (
        _within(sum(_finite(part) / 60**power for power, part in enumerate(angle)), 0, limit)
        for angle, limit in ((latitude, 90), (longitude, 180))
    )
    y, x = (size * signs.get(letter.strip(" \0"), math.nan) for size, letter in zip(sizes, (north, east), strict=True))
    return _finite(y), _finite(x)


def _within(value: Any, low: float, high: float) -> float:
    number = _finite(value)
    if not low <= number <= high:
        raise ValueError(f"expected {low} to {high}, found {number}")
    return number


def _finite(value: Any) -> float:
    number = _number(value)
    if number is None:
        raise ValueError(f"expected a finite number, found {value!r}")
    return number


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
    """Convert a tag's value, or the first of several, to a finite number; None if it is not one."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        value = value[0] if value else None
    if not isinstance(value, int | float | IFDRational):
        return None
    try:
        number = float(value)
    except (ArithmeticError, ValueError):
        return None
    return number if math.isfinite(number) else None
