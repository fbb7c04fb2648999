"""The sun by the photos' clock: from EXIF that Pillow writes, through `capture` and `check`, to clock_sun.json."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_captures import SIZE, texture
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from splatgraft.capture import sun_by_clock, sun_heights
from splatgraft.cli import main
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.clock_sun import ClockSun, Geotag
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.rotations import rotation_about
from splatgraft.core.solar_position import solar_position
from splatgraft.folders.capture_files import description_files
from splatgraft.folders.clock_sun import clock_sun_path, read_clock_sun, write_clock_sun
from splatgraft.formats import read_cameras, write_capture
from splatgraft.formats.captures.exif import read_geotag

LEWIS = Path(__file__).parents[3] / "shared" / "data" / "real" / "lewis" / "images"
OHIO, CHRISTCHURCH, FIJI = (41.4, -81.89), (-43.53, 172.64), (-17.0, 180.0)
NOON = datetime(2019, 6, 12, 16, 46, tzinfo=UTC)
METRES_PER_UNIT = 40.0
WORLD_FROM_ENU = rotation_about(torch.tensor([0.6, 0.64, 0.48], dtype=torch.float64), 2.0)

Track = Callable[[float], tuple[float, float, float]]
"""Place of a camera, metres east, north and up, by its part of the way, 0 to 1."""


def orbit(part: float) -> tuple[float, float, float]:
    angle = 2 * math.pi * part
    return 50 * math.cos(angle), 50 * math.sin(angle), 25 + 15 * math.sin(2 * angle)


def rational(value: float) -> IFDRational:
    if math.isnan(value):
        return IFDRational(0, 0)
    fraction = Fraction(value).limit_denominator(1_000_000)
    return IFDRational(fraction.numerator, fraction.denominator)


def angle(degrees: float) -> tuple[IFDRational, ...]:
    return rational(int(abs(degrees))), rational(60 * (abs(degrees) % 1)), rational(0)


def place_tags(latitude: float, longitude: float, altitude: float = 200.0) -> dict[int, Any]:
    longitude = (longitude + 180) % 360 - 180
    return {
        GPS.GPSLatitudeRef: "N" if latitude > 0 else "S",
        GPS.GPSLatitude: angle(latitude),
        GPS.GPSLongitudeRef: "E" if longitude > 0 else "W",
        GPS.GPSLongitude: angle(longitude),
        GPS.GPSAltitudeRef: b"\0",
        GPS.GPSAltitude: rational(altitude),
    }


def gps_clock(time: datetime) -> dict[int, Any]:
    parts = tuple(rational(part) for part in (time.hour, time.minute, time.second))
    return {GPS.GPSDateStamp: f"{time:%Y:%m:%d}", GPS.GPSTimeStamp: parts}


def write_photo(path: Path, gps: Mapping[int, Any], camera: Mapping[int, Any] = {}, *, seed: int = 0) -> Path:
    exif = Image.Exif()
    exif.get_ifd(IFD.GPSInfo).update(gps)
    exif.get_ifd(IFD.Exif).update(camera)
    Image.fromarray(texture(seed)).save(path, quality=95, exif=exif)
    return path


def cameras_on(track: Track, count: int, *, roll_deg: float = 0.0) -> Cameras:
    """Return cameras that look at the origin, in a world that is turned and scaled against east, north and up."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for i in range(count):
        center = torch.tensor(track(i / count), dtype=torch.float64)
        forward = torch.nn.functional.normalize(-center, dim=0)
        right = torch.linalg.cross(forward, torch.tensor([0, 0, 1.0], dtype=torch.float64))
        right = torch.nn.functional.normalize(right, dim=0)
        axes = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
        roll = math.radians(roll_deg) * math.cos(2 * math.pi * i / count)
        poses[i, :3, :3] = WORLD_FROM_ENU @ rotation_about(forward, roll) @ axes
        poses[i, :3, 3] = WORLD_FROM_ENU @ center / METRES_PER_UNIT
    intrinsics = torch.tensor([[150.0, 0, SIZE[0] / 2], [0, 150.0, SIZE[1] / 2], [0, 0, 1]]).repeat(count, 1, 1)
    names = tuple(f"{i:04d}.jpg" for i in range(count))
    return Cameras(poses.float(), intrinsics, torch.tensor([SIZE] * count), names)


def geotags(track: Track, count: int, at: tuple[float, float], *, compass: str = "") -> list[Geotag]:
    """Return what the photos of `cameras_on` know, on a sphere with the radius of the earth."""
    tags = []
    for i in range(count):
        east, north, up = track(i / count)
        degrees = math.degrees(1 / 6_371_000)
        longitude = at[1] + degrees * east / math.cos(math.radians(at[0]))
        heading = math.degrees(math.atan2(-east, -north)) % 360 if compass else None
        place = (at[0] + degrees * north, (longitude + 180) % 360 - 180, 200 + up)
        tags.append(Geotag(gps_time=NOON, position=place, heading_deg=heading, heading_is_true=compass == "T"))
    return tags


def towards_sun(at: tuple[float, float]) -> np.ndarray:
    height, azimuth = np.radians(solar_position(NOON, latitude_deg=at[0], longitude_deg=at[1]))
    enu = [math.cos(height) * math.sin(azimuth), math.cos(height) * math.cos(azimuth), math.sin(height)]
    return (WORLD_FROM_ENU @ torch.tensor(enu, dtype=torch.float64)).numpy()


def apart_deg(a: Any, b: Any) -> float:
    return math.degrees(math.acos(np.clip(np.asarray(a) @ np.asarray(b), -1, 1)))


def found(tags: list[Geotag], cameras: Cameras) -> ClockSun:
    sun = sun_by_clock(tags, cameras)
    assert sun is not None
    return sun


@pytest.mark.parametrize(
    ("time", "place", "height", "azimuth"),
    [
        # NREL/TP-560-34302, appendix A.5, before refraction
        ("2003-10-17T12:30:30-07:00", (39.742476, -105.1786), 39.872046, 194.340241),
        # the example of NREL's SOLPOS (stest00.c): Atlanta, 48.409931 less 0.0147 of refraction
        ("1999-07-22T09:45:37-05:00", (33.65, -84.43), 48.3952, 97.032875),
        # pvlib's spa_python: Nairobi, Reykjavik, and Christchurch after sunset
        ("2021-06-21T12:00:00+00:00", (-1.2921, 36.8219), 46.861904, 307.296059),
        ("2021-06-21T12:00:00+00:00", (64.1466, -21.9426), 46.702268, 149.338091),
        ("2021-12-21T09:30:00+00:00", (-43.5321, 172.6362), -11.620362, 220.937996),
    ],
)
def test_the_sun_stands_where_the_almanacs_say(
    time: str, place: tuple[float, float], height: float, azimuth: float
) -> None:
    got = solar_position(datetime.fromisoformat(time), latitude_deg=place[0], longitude_deg=place[1])
    # the almanac states 0.01 degrees for the sun's place, and parallax adds up to 0.0024
    assert got == pytest.approx((height, azimuth), abs=0.0125)


@pytest.mark.parametrize("at", [OHIO, CHRISTCHURCH, FIJI])
def test_a_track_that_is_no_line_gives_the_direction_and_the_true_up_despite_outliers(at: tuple[float, float]) -> None:
    cameras, tags = cameras_on(orbit, 40, roll_deg=15), geotags(orbit, 40, at)
    for i in (3, 17, 18, 30):
        y, x, z = tags[i].position or (0, 0, 0)
        tags[i] = replace(tags[i], position=(y + 0.002, x, (z or 0) - 90))
    sun = found(tags, cameras)
    true_up = WORLD_FROM_ENU[:, 2].numpy()
    assert apart_deg(estimate_up(cameras).double().numpy(), true_up) > 3
    # WGS 84 against a sphere: 0.5%, so 0.3 degrees; the outliers' weight adds as much
    assert apart_deg(sun.up, true_up) < 0.6
    assert apart_deg(sun.candidates[0].direction, towards_sun(at)) < 0.6
    assert sun.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=0.01)
    assert 1 < sun.error_deg < 6


def test_the_error_grows_with_the_noise_of_the_positions_and_covers_it() -> None:
    cameras, errors = cameras_on(orbit, 40), []
    for sigma in (0.0, 1e-4):  # degrees; the second is 11 m
        noise = np.random.default_rng(0).normal(size=(40, 2)) * sigma
        tags = [
            replace(tag, position=(tag.position[0] + y, tag.position[1] + x, tag.position[2]))
            for tag, (y, x) in zip(geotags(orbit, 40, OHIO), noise, strict=True)
            if tag.position is not None
        ]
        sun = found(tags, cameras)
        assert apart_deg(sun.candidates[0].direction, towards_sun(OHIO)) < 2 * sun.error_deg
        errors.append(sun.error_deg)
    assert errors[1] > 1.5 * errors[0]


def straight_up(part: float) -> tuple[float, float, float]:
    return 10.0, 30.0, 5 + 80 * part


def by_hand(part: float) -> tuple[float, float, float]:
    return 4 * part - 2, 6.0, 1.6


@pytest.mark.parametrize(("track", "up_deg"), [(straight_up, 2), (by_hand, 4)])
def test_a_line_gives_no_azimuth_alone_but_with_the_compass(track: Track, up_deg: float) -> None:
    cameras, true_up = cameras_on(track, 20), WORLD_FROM_ENU[:, 2].numpy()
    alone, by_true, by_magnetic = (found(geotags(track, 20, OHIO, compass=kind), cameras) for kind in ("", "T", "M"))
    assert alone.candidates[0].direction is None
    # the way up gives up, although the cameras' estimate is 48 degrees off; that by hand leaves 3.5 degrees
    assert apart_deg(alone.up, true_up) < up_deg
    assert (alone.metres_per_unit is None) == (track is by_hand)
    for sun in (by_true, by_magnetic):
        assert apart_deg(sun.candidates[0].direction, towards_sun(OHIO)) < up_deg
        assert sun.error_deg > up_deg
    assert by_true.error_deg < by_magnetic.error_deg


def test_a_long_level_line_gives_the_azimuth_with_the_cameras_up() -> None:
    def line(part: float) -> tuple[float, float, float]:
        return 100 * part - 50, 40.0, 20.0

    sun = found(geotags(line, 20, OHIO), cameras_on(line, 20))
    assert "up direction" in sun.source
    assert apart_deg(sun.candidates[0].direction, towards_sun(OHIO)) < 1.5


def test_a_compass_that_does_not_turn_with_the_cameras_is_not_used() -> None:
    cameras = cameras_on(orbit, 30)
    tags = [Geotag(gps_time=NOON, position=(*OHIO, None), heading_deg=127.0) for _ in range(30)]
    assert found(tags, cameras).candidates[0].direction is None


WINTER = datetime(2019, 1, 12, 12, 0, tzinfo=UTC)


@pytest.mark.parametrize(
    ("gps", "camera", "offset", "at", "utc"),
    [
        (NOON, "2019:06:12 12:46:20", "", OHIO, ["06-12 16:46"]),
        (None, "2019:06:12 12:46:00", "-03:00", OHIO, ["06-12 15:46"]),
        (None, "2019:06:12 12:46:00", "+00:00", OHIO, ["06-12 12:46"]),
        # no offset: the longitude's, with daylight saving time first in the summer of either hemisphere
        (None, "2019:06:12 12:46:00", "", OHIO, ["06-12 16:46", "06-12 17:46"]),
        (None, "2019:01:12 12:46:00", "", OHIO, ["01-12 17:46", "01-12 16:46"]),
        (None, "2019:06:12 12:46:00", "", CHRISTCHURCH, ["06-12 00:46", "06-11 23:46"]),
        (None, "2019:01:12 12:46:00", "", CHRISTCHURCH, ["01-11 23:46", "01-12 00:46"]),
        # clocks that lie: an hour that only winter explains, half an hour, another offset, another year
        (NOON, "2019:06:12 11:46:00", "", OHIO, ["06-12 16:46", "06-12 15:46"]),
        (NOON, "2019:06:12 13:16:00", "", OHIO, ["06-12 16:46", "06-12 17:16"]),
        (NOON, "2019:06:12 12:46:00", "-05:00", OHIO, ["06-12 16:46", "06-12 17:46"]),
        (NOON, "2000:01:01 00:10:00", "", OHIO, ["06-12 16:46", "01-01 05:10"]),
        (WINTER, "2019:01:12 07:00:00", "", OHIO, ["01-12 12:00"]),
        (None, "2019:06:12 12:46:00", "-04:00", None, []),
        (NOON, "", "", None, []),
        (None, "0000:00:00 00:00:00", "", OHIO, []),
    ],
)
def test_candidates_of_the_time(
    gps: datetime | None, camera: str, offset: str, at: tuple[float, float] | None, utc: list[str], tmp_path: Path
) -> None:
    tags = gps_clock(gps) if gps else {}
    tags |= place_tags(*at) if at else {}
    own = {Base.DateTimeOriginal: camera, Base.OffsetTimeOriginal: offset}
    read = read_geotag(write_photo(tmp_path / "a.jpg", tags, {tag: value for tag, value in own.items() if value}))
    assert read.broken == ()
    suns = sun_heights([read])
    assert [f"{sun.time.astimezone(UTC):%m-%d %H:%M}" for sun in suns] == utc
    for sun in suns:
        assert at is not None
        height, _ = solar_position(sun.time, latitude_deg=at[0], longitude_deg=at[1])
        assert sun.height_deg == pytest.approx(height, abs=0.001)


@pytest.mark.parametrize(
    ("gps", "camera", "broken"),
    [
        ({GPS.GPSLatitude: (rational(91), rational(0), rational(0))}, {}, "GPSLatitude, GPSLongitude"),
        ({GPS.GPSLatitude: (rational(math.nan),) * 3}, {}, "GPSLatitude, GPSLongitude"),
        ({GPS.GPSLongitude: rational(12.5)}, {}, "GPSLatitude, GPSLongitude"),
        ({GPS.GPSLongitudeRef: "X"}, {}, "GPSLatitude, GPSLongitude"),
        ({GPS.GPSAltitude: rational(math.nan)}, {}, "GPSAltitude"),
        ({GPS.GPSTimeStamp: (rational(25), rational(0), rational(0))}, {}, "GPSDateStamp, GPSTimeStamp"),
        ({GPS.GPSTimeStamp: (rational(5), rational(0))}, {}, "GPSDateStamp, GPSTimeStamp"),
        ({GPS.GPSDateStamp: "yesterday"}, {}, "GPSDateStamp, GPSTimeStamp"),
        ({GPS.GPSDateStamp: "1980:01:06"}, {}, "GPSDateStamp, GPSTimeStamp"),
        ({GPS.GPSImgDirection: rational(400)}, {}, "GPSImgDirection"),
        ({}, {Base.DateTimeOriginal: "2019:13:45 99:00:00"}, "DateTimeOriginal"),
        ({}, {Base.OffsetTimeOriginal: "+99:00"}, "OffsetTimeOriginal"),
        ({}, {Base.OffsetTimeOriginal: "CEST"}, "OffsetTimeOriginal"),
    ],
)
def test_impossible_values_count_as_missing_and_are_named(
    gps: dict[int, Any], camera: dict[int, Any], broken: str, tmp_path: Path
) -> None:
    whole = {**place_tags(*OHIO), **gps_clock(NOON), GPS.GPSImgDirection: rational(30)}
    own = {Base.DateTimeOriginal: "2019:06:12 12:46:00", Base.OffsetTimeOriginal: "-04:00"}
    good = read_geotag(write_photo(tmp_path / "a.jpg", whole, own))
    bad = read_geotag(write_photo(tmp_path / "b.jpg", whole | gps, own | camera))
    assert good.broken == ()
    assert bad.broken == (broken,)
    lost = {name for name, value in vars(bad).items() if value != vars(good)[name]} - {"broken"}
    assert len(lost) == 1
    # the place survives a broken altitude
    assert (bad.position is None) == broken.startswith("GPSLat")


def write_outdoors(folder: Path, tags: list[Geotag], cameras: Cameras, more: Mapping[int, Any] = {}) -> Path:
    """Write a posed capture whose photos have the tags in EXIF; `more` replaces those of the first photo."""
    (folder / "images").mkdir(parents=True)
    paths = []
    for i, (tag, name) in enumerate(zip(tags, cameras.names, strict=True)):
        assert tag.position is not None
        gps = place_tags(tag.position[0], tag.position[1], tag.position[2] or 0.0) | gps_clock(NOON)
        own = {Base.DateTimeOriginal: "2019:06:12 12:46:00"}
        paths.append(write_photo(folder / "images" / name, gps | (more if i == 0 else {}), own, seed=i))
    points = 0.3 * torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
    posed = PosedImages(tuple(paths), cameras, points=points, point_colors=torch.full((60, 3), 0.5))
    write_capture(folder, posed)
    return folder


@pytest.fixture
def outdoors(tmp_path: Path) -> Path:
    return write_outdoors(tmp_path / "c", geotags(orbit, 14, OHIO), cameras_on(orbit, 14))


def test_capture_keeps_the_sun_but_no_place_and_check_says_it(
    outdoors: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["capture", str(outdoors), "--out", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    sun = read_clock_sun(tmp_path / "out")
    assert sun is not None
    assert apart_deg(sun.candidates[0].direction, towards_sun(OHIO)) < 0.6
    sentence = sun.describe(read_cameras(tmp_path / "out"))
    assert sentence.startswith(f"12 June 2019, 12:46 UTC-04:00 by GPS: sun {sun.candidates[0].height_deg:.1f} degrees")
    assert f"{outdoors}: {sentence}" in said
    text = clock_sun_path(tmp_path / "out").read_text()
    assert not any(number in text for number in ("41.4", "81.8", "81.9"))
    # the poses' steps do not depend on it
    assert clock_sun_path(tmp_path / "out") not in description_files(tmp_path / "out")
    assert main(["check", str(outdoors)]) == 0
    assert sentence in capsys.readouterr().out
    # a capture of the result, whose images have no such EXIF, keeps it
    assert main(["capture", str(tmp_path / "out"), "--out", str(tmp_path / "again"), "--max-side", "80"]) == 0
    assert read_clock_sun(tmp_path / "again") == sun
    assert main(["capture", str(outdoors), "--out", str(tmp_path / "none"), "--no-clock-sun"]) == 0
    assert not clock_sun_path(tmp_path / "none").exists()
    # without poses only the height is known
    for photo in sorted((outdoors / "images").iterdir())[3:]:
        photo.unlink()
    main(["check", str(outdoors / "images")])
    line = next(line for line in capsys.readouterr().out.splitlines() if "12 June 2019" in line)
    assert line.endswith(f"by GPS: sun {sun.candidates[0].height_deg:.1f} degrees high")


def test_the_side_of_the_sun_is_that_of_the_first_photo() -> None:
    cameras, tags = cameras_on(orbit, 16), geotags(orbit, 16, OHIO)
    _, azimuth = solar_position(NOON, latitude_deg=OHIO[0], longitude_deg=OHIO[1])
    for first in range(16):
        east, north, _ = orbit(first / 16)
        turn = (azimuth - math.degrees(math.atan2(-east, -north))) % 360  # from the view, clockwise
        side = ("from ahead", "from the right", "from behind", "from the left")[round(turn / 90) % 4]
        order = [*range(first, 16), *range(first)]
        assert f", {side} in the first photo" in found([tags[i] for i in order], cameras[order]).describe(
            cameras[order]
        )


def test_broken_exif_is_said_and_stops_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = {GPS.GPSLatitude: (rational(math.nan),) * 3, GPS.GPSTimeStamp: (rational(77),) * 3}
    write_outdoors(tmp_path / "c", geotags(orbit, 14, OHIO), cameras_on(orbit, 14), bad)
    assert main(["capture", str(tmp_path / "c"), "--out", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    for name in ("GPSLatitude, GPSLongitude", "GPSDateStamp, GPSTimeStamp"):
        assert f"EXIF {name}: expected a possible value, found none in 1 photos, such as 0000.jpg" in said
    sun = read_clock_sun(tmp_path / "out")
    assert sun is not None
    assert apart_deg(sun.candidates[0].direction, towards_sun(OHIO)) < 0.6


def test_photos_of_several_days_give_no_sun_and_it_is_said(outdoors: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i, photo in enumerate(sorted((outdoors / "images").iterdir())):
        write_photo(photo, place_tags(*OHIO), {Base.DateTimeOriginal: f"2019:06:{12 + i} 12:46:00"}, seed=i)
    assert main(["capture", str(outdoors), "--out", str(outdoors.parent / "out")]) == 0
    assert "the times of the photos differ by hours" in " ".join(capsys.readouterr().err.split())
    assert read_clock_sun(outdoors.parent / "out") is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"time": "2019', '"time": "soon', "expected a candidate with a time and its offset"),
        ("-04:00", "", "expected a candidate with a time and its offset"),
        ('"error_deg": ', '"error_deg": "big", "x": ', "expected a finite number for 'error_deg'"),
        ('"up": [', '"up": [9,', "expected numbers of shape"),
        ('"candidates"', '"c"', "expected an object with a list of candidates"),
    ],
)
def test_a_damaged_file_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    local = [replace(tag, gps_time=NOON.astimezone(timezone(timedelta(hours=-4)))) for tag in geotags(orbit, 14, OHIO)]
    write_clock_sun(tmp_path, found(local, cameras_on(orbit, 14)))
    path = clock_sun_path(tmp_path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ValueError, match=message) as error:
        read_clock_sun(tmp_path)
    assert str(error.value).startswith(str(path))


def test_a_file_without_the_error_of_the_heights_takes_that_of_the_directions(tmp_path: Path) -> None:
    sun = found(geotags(orbit, 14, OHIO), cameras_on(orbit, 14))
    write_clock_sun(tmp_path, sun)
    content = json.loads(clock_sun_path(tmp_path).read_text())
    assert content.pop("height_error_deg") == sun.height_error_deg < sun.error_deg
    clock_sun_path(tmp_path).write_text(json.dumps(content))
    older = read_clock_sun(tmp_path)
    assert older is not None
    assert older.height_error_deg == older.error_deg == sun.error_deg


@pytest.mark.skipif(not LEWIS.is_dir(), reason="the photos are not part of the repository")
def test_photos_of_a_drone_whose_clocks_disagree() -> None:
    by_gps, by_camera = sun_heights([read_geotag(LEWIS / "img_4078.jpg")])
    # computed with NOAA's formulae for 21:46 UTC, and for 16:46 in Ohio's summer time; the photo is 43 s later
    assert by_gps.height_deg == pytest.approx(32.8, abs=0.2)
    assert by_camera.height_deg == pytest.approx(44.0, abs=0.2)
