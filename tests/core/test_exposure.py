"""Exposure: cameras' tags in image files, the scale that settings give to pixel values, and their messages."""

import math
from pathlib import Path

import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from splatgraft.core.exposure import Exposure, describe_inconsistency, relative_gains
from splatgraft.formats.captures.exif import exif_of, read_exposure

PHONE = {
    Base.ExposureTime: IFDRational(1, 60),
    Base.FNumber: IFDRational(9, 5),
    Base.ISOSpeedRatings: 125,
    Base.ExposureBiasValue: IFDRational(-1, 3),
    Base.BrightnessValue: IFDRational(5, 2),
    Base.WhiteBalance: 0,
}


def photo(path: Path, tags: dict) -> Path:
    if path.suffix == ".tif":
        info = ImageFileDirectory_v2()
        info[IFD.Exif] = tags
        Image.new("RGB", (16, 12)).save(path, tiffinfo=info)
        return path
    exif = Image.Exif()
    exif[Base.Make] = "Maker"  # without a tag here Pillow writes none to PNG
    for tag, value in tags.items():
        exif.get_ifd(IFD.Exif)[tag] = value
    Image.new("RGB", (16, 12)).save(path, exif=exif)
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_settings_of_a_photo_are_read_from_every_format(tmp_path, suffix):
    found = read_exposure(photo(tmp_path / f"a{suffix}", PHONE))
    assert found == Exposure(1 / 60, 1.8, 125.0, -1 / 3, 2.5, auto_white_balance=True)


@pytest.mark.parametrize(
    ("tag", "value", "field"),
    [
        (Base.ExposureTime, IFDRational(1, 0), "shutter_s"),
        (Base.ExposureTime, "1/60", "shutter_s"),
        (Base.FNumber, b"\x00\x01", "aperture"),
        (Base.ISOSpeedRatings, 0, "iso"),
        (Base.BrightnessValue, IFDRational(4294967295, 10), "brightness_stops"),
        (Base.WhiteBalance, "auto", "auto_white_balance"),
    ],
)
def test_a_value_that_cannot_be_is_not_known_and_the_others_are(tmp_path, tag, value, field):
    found = read_exposure(photo(tmp_path / "a.jpg", PHONE | {tag: value}))
    assert {name for name, known in vars(found).items() if known is None} == {field}


def test_damaged_metadata_tells_nothing_and_a_broken_file_is_an_error(tmp_path):
    # the first of several sensitivities counts
    assert read_exposure(photo(tmp_path / "a.jpg", {Base.ISOSpeedRatings: (200, 400)})).iso == 200
    path = photo(tmp_path / "a.jpg", PHONE)
    content = bytearray(path.read_bytes())
    start = content.index(b"Exif\x00\x00")
    # the byte order mark stays, every offset and count behind it becomes nonsense
    content[start + 10 : start + 60] = bytes([0xFF]) * 50
    path.write_bytes(content)
    assert read_exposure(path) == Exposure()
    (tmp_path / "b.jpg").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"b\.jpg: expected a readable image"):
        read_exposure(tmp_path / "b.jpg")


@pytest.mark.parametrize(
    "exposure",
    [
        Exposure(),
        Exposure(1 / 8000, 1.78, 50.0, -2.0, -3.25, auto_white_balance=False),
        Exposure(shutter_s=30.0, iso=6400.0, auto_white_balance=True),
    ],
)
def test_what_is_written_is_read_again(tmp_path, exposure):
    Image.new("RGB", (16, 12)).save(tmp_path / "a.jpg", exif=exif_of(exposure))
    for name, value in vars(read_exposure(tmp_path / "a.jpg")).items():
        wanted = getattr(exposure, name)
        # fractions with denominators up to a million
        assert value == wanted or math.isclose(value, wanted, rel_tol=1e-2 if name == "shutter_s" else 1e-5)


SUNNY = Exposure(shutter_s=1 / 100, aperture=16.0, iso=100.0)


def test_settings_of_equal_exposure_have_one_exposure_value_and_brightness_replaces_missing_ones():
    assert SUNNY.ev100 is not None
    # the APEX equation Av + Tv = Bv + Sv with Av = 8, Tv = log2(100), Sv = 5
    brightness = 8 + math.log2(100) - 5
    for exposure, stops in (
        (Exposure(shutter_s=1 / 400, aperture=8.0, iso=100.0), 0),
        (Exposure(shutter_s=1 / 200, aperture=16.0, iso=200.0), 0),
        (Exposure(shutter_s=1 / 50, aperture=16.0, iso=100.0), 1),
        (Exposure(aperture=16.0, brightness_stops=brightness), 0),
        (Exposure(brightness_stops=brightness, bias_stops=1.0), 1),
    ):
        assert exposure.ev100 == pytest.approx(SUNNY.ev100 - stops)
    assert Exposure(shutter_s=0.01, aperture=16.0).ev100 is None


def test_what_differs_is_named_with_both_ends_and_little_or_no_data_is_not_worth_a_line():
    photos = [Exposure(1 / 60, 1.8, 100.0), Exposure(1 / 250, 1.8, 100.0), Exposure(1 / 125, 1.8, 100.0), Exposure()]
    line = describe_inconsistency(photos) or ""
    assert "from 1/250 s f/1.8 ISO 100 to 1/60 s f/1.8 ISO 100, 2.1 stops apart" in line
    assert "white balance in" not in line
    assert "\n" not in line
    auto, fixed = (Exposure(1 / 60, 1.8, 100.0, auto_white_balance=value) for value in (True, False))
    assert "automatic white balance in 1 of 2 photos" in (describe_inconsistency([auto, fixed]) or "")
    assert "automatic white balance;" in (describe_inconsistency([auto, auto]) or "")
    one_step_of_the_dial = [Exposure(t, 8.0, 100.0, auto_white_balance=False) for t in (1 / 160, 1 / 125)]
    for photos in (one_step_of_the_dial, [Exposure(), Exposure()], []):
        assert describe_inconsistency(photos) is None


def test_settings_are_written_as_photographers_do():
    assert str(Exposure(2.5, 11.0, 64.0)) == "2.5 s f/11 ISO 64"
    assert str(Exposure(brightness_stops=2.0)) == "EV 7.0"
    assert str(Exposure()) == "unknown settings"


def test_a_photo_exposed_longer_is_brighter_by_its_settings():
    short, long_, unknown = Exposure(1 / 120, 2.0, 100.0), Exposure(1 / 30, 2.0, 100.0), Exposure()
    gains = relative_gains([short, long_, unknown])
    # two stops are a factor of four on linear light
    assert gains[1] / gains[0] == pytest.approx(4 ** (1 / 2.2))
    assert sum(gains) == pytest.approx(3)
    assert gains[0] < gains[2] < gains[1]
    assert relative_gains([unknown, unknown]) == [1.0, 1.0]
