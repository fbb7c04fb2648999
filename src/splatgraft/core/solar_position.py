"""The sun's height and azimuth, by the low-precision formulae of the Astronomical Almanac (page C5; 0.01 degrees until
2050) and the mean sidereal time."""

from datetime import UTC, datetime
from math import asin, atan2, cos, degrees, radians, sin

_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_DAY_SECONDS = 86400.0


def solar_position(time: datetime, *, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Compute the height and azimuth of the sun's centre, without refraction.

    Args:
        time: A time with its offset from UTC.
        latitude_deg: Geodetic latitude, degrees; north is positive.
        longitude_deg: Longitude, degrees; east is positive.

    Returns:
        Height above the horizon, degrees, and azimuth, degrees in [0, 360), from true north clockwise.
    """
    days = (time - _J2000).total_seconds() / _DAY_SECONDS
    anomaly = radians(357.528 + 0.9856003 * days)
    mean_longitude = 280.460 + 0.9856474 * days
    ecliptic = radians(mean_longitude + 1.915 * sin(anomaly) + 0.020 * sin(2 * anomaly))
    obliquity = radians(23.439 - 0.0000004 * days)
    right_ascension = atan2(cos(obliquity) * sin(ecliptic), cos(ecliptic))
    declination = asin(sin(obliquity) * sin(ecliptic))
    sidereal = radians(280.46061837 + 360.98564736629 * days + longitude_deg)
    hour_angle, latitude = sidereal - right_ascension, radians(latitude_deg)
    east = -cos(declination) * sin(hour_angle)
    north = cos(latitude) * sin(declination) - sin(latitude) * cos(declination) * cos(hour_angle)
    up = sin(latitude) * sin(declination) + cos(latitude) * cos(declination) * cos(hour_angle)
    return degrees(asin(max(-1.0, min(1.0, up)))), degrees(atan2(east, north)) % 360
