"""The sun's direction in a capture's world, from the time, the place and the compass of its photos.

Time and place give the sun's height and azimuth. A similarity fitted to camera centres and GPS positions (Umeyama
1991), reweighted for outliers, gives the rotation from east, north and up to the world. If the track is too short or
too straight, it is fitted together with the cameras' up direction and the compass (Wahba's problem).
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.clock_sun import ClockSun, Geotag, SunCandidate
from splatgraft.core.directions import tangents
from splatgraft.core.solar_position import solar_position
from splatgraft.runtime.note import Note

# clocks
_AGREE = timedelta(minutes=5)  # between GPS and camera; the sun moves by a degree in this time
_QUARTER_S = 900.0  # all time zones are whole quarters of an hour from UTC
_MAX_OFFSET_S = 14 * 3600.0  # Kiribati
_TROPIC_DEG = 23.4  # countries between the tropics have no daylight saving time
_MAX_SPREAD_H = 1.0  # standard deviation of the photos' times; the sun moves by up to 15 degrees in this time

# standard errors of the orientation, set by hand
_GPS_M = 3.0  # smallest error of a GPS position; residuals may be smaller, because neighbours' errors correlate
_INDEPENDENT = 4  # number of readings that count as independent, because GPS and compass drift slowly
_LEVEL_RAD = math.radians(5)  # level of cameras about either axis; those of a drone without gimbal were 7 off in all
_PITCH_RAD = math.radians(20)  # up direction about the cameras' horizontal axes if these are parallel
_COMPASS_RAD = math.radians(10)  # a phone's compass
_DECLINATION_RAD = math.radians(10)  # rms of the unknown magnetic declination
_KNOWN_RAD = math.radians(30)  # largest error of an angle that counts as known
_ROUNDS = 20  # iterations of reweighting
_RESIDUAL_FLOOR = 0.1  # residual, over the median, below which weights stop growing
_MIN_POSITIONS = 4
_MAXWELL_MEDIAN = 1.538  # median length of a normal vector in space, over the standard deviation along an axis
_MIN_LEVEL = 0.3  # smallest cosine of a view's angle to the horizon whose compass direction counts

_UP = np.array([0.0, 0.0, 1.0])  # in axes east, north, up
_SUN_DEG_PER_H = 15.0
_EAST_RADIUS_M = 111_320.0  # metres per degree at the equator, by WGS 84
_NORTH_RADIUS_M = 111_130.0  # metres per degree of latitude, mean


@dataclass(frozen=True)
class _Orientation:
    enu_from_world: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "3 3"]
    """Covariance of small rotations about east, north and up, square radians."""
    source: str
    metres_per_unit: float | None


def sun_heights(tags: Sequence[Geotag]) -> tuple[SunCandidate, ...]:
    """Compute the sun's height at each reading of the clocks, the most trusted first; empty as for `sun_by_clock`."""
    return tuple(sun for sun, _ in _suns(tags)) if _spread_hours(tags) <= _MAX_SPREAD_H else ()


def sun_by_clock(tags: Sequence[Geotag], cameras: Cameras) -> ClockSun | None:
    """Compute the sun's direction at the time of the photos; None without time or place, or if the photos took hours.

    Args:
        tags: Metadata of each photo.
        cameras: The photos' cameras, in the same order.
    """
    suns, spread_h = _suns(tags), _spread_hours(tags)
    if not suns or spread_h > _MAX_SPREAD_H:
        return None
    found = _orientation(tags, cameras)
    knows_north = found.covariance[2, 2] < _KNOWN_RAD**2
    candidates, variances, of_heights = [], [], []
    for sun, azimuth_deg in suns:
        height, azimuth = math.radians(sun.height_deg), math.radians(azimuth_deg)
        level = np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
        towards = math.cos(height) * level + math.sin(height) * _UP
        x, y, z = (found.enu_from_world.T @ towards).tolist()
        candidates.append(replace(sun, direction=(x, y, z) if knows_north else None))
        # a small rotation r moves the height by r . (level x up), and the direction by r x direction
        tilts, moves = np.cross(level, _UP), np.cross(np.eye(3), towards)
        of_heights.append(float(tilts @ found.covariance @ tilts))
        variances.append(float(np.trace(moves.T @ found.covariance @ moves)) if knows_north else of_heights[-1])
    x, y, z = (found.enu_from_world.T @ _UP).tolist()
    error_deg, height_error_deg = (
        math.hypot(math.degrees(math.sqrt(max(one))), _SUN_DEG_PER_H * spread_h) for one in (variances, of_heights)
    )
    return ClockSun(tuple(candidates), (x, y, z), error_deg, height_error_deg, found.source, found.metres_per_unit)


def geotag_notes(tags: Sequence[Geotag], names: Sequence[str]) -> list[Note]:
    """Describe unused metadata: tags with impossible values, each with its first photo, and times hours apart."""
    first: dict[str, str] = {}
    for tag, photo in zip(tags, names, strict=True):
        first |= {name: photo for name in tag.broken if name not in first}
    count = Counter(name for tag in tags for name in tag.broken)
    text = "EXIF {}: expected a possible value, found none in {} photos, such as {}; it is not used"
    notes = [Note(text.format(name, count[name], photo), "minor") for name, photo in first.items()]
    spread_h = _spread_hours(tags)
    if spread_h > _MAX_SPREAD_H:
        text = f"the times of the photos differ by hours (standard deviation {spread_h:.1f} h): they give no sun"
        notes.append(Note(text))
    return notes


def _suns(tags: Sequence[Geotag]) -> list[tuple[SunCandidate, float]]:
    """Return the sun at each reading of the clocks, and its azimuth, degrees."""
    places = [tag.position for tag in tags if tag.position is not None]
    if not places:
        return []
    longitude, latitude = _median_place(places)
    suns = []
    for time, clock in _times(tags, latitude=latitude, longitude=longitude):
        height, azimuth = solar_position(time, latitude_deg=latitude, longitude_deg=longitude)
        suns.append((SunCandidate(time, clock, height), azimuth))
    return suns


def _median_place(places: Sequence[tuple[float, float, float | None]]) -> tuple[float, float]:
    """Return the median longitude and latitude; longitudes may jump from 180 to -180."""
    east = [(longitude - places[0][1] + 180) % 360 - 180 for _, longitude, _ in places]
    return places[0][1] + float(np.median(east)), float(np.median([latitude for latitude, _, _ in places]))


def _times(tags: Sequence[Geotag], *, latitude: float, longitude: float) -> list[tuple[datetime, str]]:
    """Return the median times by the clocks; one if GPS and camera agree, or if only one of them is known."""
    gps = [tag.gps_time for tag in tags if tag.gps_time is not None]
    camera = [tag.camera_time for tag in tags if tag.camera_time is not None]
    if not camera:
        return [(_median(gps), "GPS")] if gps else []
    local = _median(camera)
    offsets = _offsets(tags, local, latitude, longitude)
    by_camera = [(local.replace(tzinfo=timezone(offset)), "the camera's clock") for offset in offsets]
    if not gps:
        return by_camera
    both = [tag.camera_time - tag.gps_time.replace(tzinfo=None) for tag in tags if tag.camera_time and tag.gps_time]
    ahead = sorted(both)[len(both) // 2] if both else local - _median(gps).replace(tzinfo=None)
    # GPS time is shown in the time zone of the camera's clock
    zone_s = round(ahead.total_seconds() / _QUARTER_S) * _QUARTER_S
    zone = timezone(timedelta(seconds=zone_s)) if abs(zone_s) <= _MAX_OFFSET_S else UTC
    by_gps = (_median(gps).astimezone(zone), "GPS")
    return [by_gps] if abs(ahead - offsets[0]) <= _AGREE else [by_gps, by_camera[0]]


def _offsets(tags: Sequence[Geotag], local: datetime, latitude: float, longitude: float) -> list[timedelta]:
    """Return the offset of the camera's clock from UTC, or the likely ones at this longitude, the likeliest first."""
    stated = Counter(tag.camera_offset for tag in tags if tag.camera_offset is not None)
    if stated:
        return [stated.most_common(1)[0][0]]
    standard = round(((longitude + 180) % 360 - 180) / 15)
    april_to_october = 4 <= local.month <= 10
    summer = april_to_october if latitude > _TROPIC_DEG else latitude < -_TROPIC_DEG and not 4 <= local.month <= 9
    hours = (standard + 1, standard) if summer else (standard, standard + 1)
    return [timedelta(hours=one) for one in hours]


def _median(times: Sequence[datetime]) -> datetime:
    return sorted(times)[len(times) // 2]


def _spread_hours(tags: Sequence[Geotag]) -> float:
    """Return the standard deviation of the photos' times, hours, without a tenth of outliers at either end."""
    times = [tag.gps_time for tag in tags if tag.gps_time] or [tag.camera_time for tag in tags if tag.camera_time]
    if not times:
        return 0.0
    hours = [(time - times[0]).total_seconds() / 3600 for time in times]
    low, high = np.percentile(hours, [10, 90])
    return float(high - low) / 2.56  # of a normal distribution


def _orientation(tags: Sequence[Geotag], cameras: Cameras) -> _Orientation:
    """Find the rotation from the world to east, north and up."""
    tracked = np.array([tag.position is not None for tag in tags])
    right, _, forward = np.moveaxis(cameras.world_from_camera[:, :3, :3].double().cpu().numpy(), 2, 0)
    attitude, information, sources, scale = np.zeros((3, 3)), 1e-9 * np.eye(3), [], None
    if tracked.sum() >= _MIN_POSITIONS:
        attitude, of_track, metres = _fit(_metres(tags), cameras.centers.double().cpu().numpy()[tracked])
        known = np.linalg.eigvalsh(of_track)
        information = information + of_track
        if known[1] > _KNOWN_RAD**-2:  # a line is known about two axes
            sources, scale = [f"the track of {tracked.sum()} GPS positions"], metres
        if known[0] > _LEVEL_RAD**-2:
            return _Orientation(_rotation(attitude), np.linalg.inv(information), sources[0], scale)
    up = estimate_up(cameras).double().cpu().numpy()
    # cameras that look one way do not show how far all of them look down
    across = np.cross(up, right)
    of_up = 2 * across.T @ across / len(across) / _LEVEL_RAD**2 + np.eye(3) / _PITCH_RAD**2
    attitude = attitude + np.outer(_UP, up) / _PITCH_RAD**2
    north, error, source = _compass(tags, forward, up=_rotation(attitude).T @ _UP)
    if error < _KNOWN_RAD:
        attitude, sources = attitude + np.outer([0, 1, 0], north) / error**2, [*sources, source]
        information = information + np.outer(_UP, _UP) / error**2
    rotation = _rotation(attitude)
    level = np.eye(3) - np.outer(_UP, _UP)
    information = information + level @ rotation @ of_up @ rotation.T @ level
    source = " and ".join([*sources, "the cameras' up direction"])
    return _Orientation(rotation, np.linalg.inv(information), source, scale)


def _rotation(attitude: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation R that maximises trace(R^T attitude), for a sum of a b^T that R should take from b to a."""
    u, _, vt = np.linalg.svd(attitude)
    return u * [1, 1, np.sign(np.linalg.det(u @ vt))] @ vt


def _metres(tags: Sequence[Geotag]) -> Float[np.ndarray, "n 3"]:
    """Return the known positions as metres east, north and up of their median; an unknown altitude is the median."""
    places = [tag.position for tag in tags if tag.position is not None]
    if not places:
        return np.zeros((0, 3))
    longitude, latitude = _median_place(places)
    altitudes = [place[2] for place in places if place[2] is not None]
    middle = float(np.median(altitudes)) if altitudes else 0.0
    east_m = _EAST_RADIUS_M * math.cos(math.radians(latitude))
    return np.array(
        [
            (
                ((x - longitude + 180) % 360 - 180) * east_m,
                (y - latitude) * _NORTH_RADIUS_M,
                0.0 if z is None else z - middle,
            )
            for y, x, z in places
        ]
    )


def _fit(
    metres: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"], float]:
    """Fit the similarity from `points` to `metres` by iteratively reweighted least squares.

    Returns:
        The attitude matrix of the rotation; the inverse covariance of small rotations; metres per world unit.
    """
    weight, attitude, scale = np.full(len(metres), 1 / len(metres)), np.zeros((3, 3)), 0.0
    for _ in range(_ROUNDS):
        target, offset = metres - weight @ metres, points - weight @ points
        attitude = (target * weight[:, None]).T @ offset
        rotation = _rotation(attitude)
        scale = max(0.0, float(np.trace(rotation.T @ attitude) / max(weight @ (offset**2).sum(1), 1e-12)))
        turned = scale * offset @ rotation.T
        residual = np.linalg.norm(target - turned, axis=1)
        weight = 1 / (residual + _RESIDUAL_FLOOR * np.median(residual) + 1e-9)
        weight /= weight.sum()
    sigma = max(float(np.median(residual)) / _MAXWELL_MEDIAN, _GPS_M)
    count = min(len(metres), _INDEPENDENT) / sigma**2
    spread = (turned * weight[:, None]).T @ turned
    return np.asarray(count * scale * attitude), count * (np.trace(spread) * np.eye(3) - spread), scale


def _compass(
    tags: Sequence[Geotag], forward: Float[np.ndarray, "v 3"], *, up: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], float, str]:
    """Return north in the world, its standard error, radians (pi without a compass), and the source."""
    east, ahead = (axis.numpy() for axis in tangents(torch.from_numpy(up)))
    x, y = forward @ east, forward @ ahead
    used = [i for i, tag in enumerate(tags) if tag.heading_deg is not None and math.hypot(x[i], y[i]) > _MIN_LEVEL]
    if not used:
        return ahead, math.pi, ""
    norths = np.arctan2(y[used], x[used]) + np.radians([tags[i].heading_deg or 0.0 for i in used])
    apart = np.abs((norths[:, None] - norths + math.pi) % (2 * math.pi) - math.pi)
    best = int(apart.sum(1).argmin())
    spread = 1.483 * float(np.median(apart[best]))  # standard deviation of a normal distribution
    is_true = all(tags[i].heading_is_true for i in used)
    own = math.hypot(_COMPASS_RAD, 0.0 if is_true else _DECLINATION_RAD)
    error = math.hypot(own, spread / math.sqrt(min(len(used), _INDEPENDENT)))
    north = math.cos(norths[best]) * east + math.sin(norths[best]) * ahead
    return north, error, f"the {'' if is_true else 'magnetic '}compass in {len(used)} photos"
