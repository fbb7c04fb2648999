"""Exposure metadata of real image files: cameras' tags, and tags that are missing, zero, or of another type."""

import math
from pathlib import Path

import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from splatgraft.core.exposure import Exposure
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


def test_a_photo_without_metadata_tells_nothing(tmp_path):
    Image.new("RGB", (16, 12)).save(tmp_path / "a.jpg")
    assert read_exposure(tmp_path / "a.jpg") == Exposure()


def test_apex_values_replace_shutter_and_aperture(tmp_path):
    tags = {Base.ShutterSpeedValue: IFDRational(6), Base.ApertureValue: IFDRational(4), Base.ISOSpeedRatings: 100}
    found = read_exposure(photo(tmp_path / "a.jpg", tags))
    assert (found.shutter_s, found.aperture) == (1 / 64, 4.0)


def test_sensitivities_beyond_16_bits_are_in_other_tags(tmp_path):
    tags = {Base.ISOSpeedRatings: 65535, Base.RecommendedExposureIndex: 102400}
    assert read_exposure(photo(tmp_path / "a.jpg", tags)).iso == 102400
    assert read_exposure(photo(tmp_path / "b.jpg", {Base.ISOSpeedRatings: 65535})).iso is None


@pytest.mark.parametrize(
    ("tag", "value"),
    [
        (Base.ExposureTime, IFDRational(1, 0)),
        (Base.ExposureTime, IFDRational(0, 1)),
        (Base.ExposureTime, "1/60"),
        (Base.FNumber, IFDRational(0, 0)),
        (Base.FNumber, b"\x00\x01"),
        (Base.ISOSpeedRatings, 0),
        (Base.BrightnessValue, IFDRational(4294967295, 10)),
        (Base.WhiteBalance, 7),
        (Base.WhiteBalance, "auto"),
    ],
)
def test_a_value_that_cannot_be_is_not_known_and_the_others_are(tmp_path, tag, value):
    found = read_exposure(photo(tmp_path / "a.jpg", PHONE | {tag: value}))
    names = {
        Base.ExposureTime: "shutter_s",
        Base.FNumber: "aperture",
        Base.ISOSpeedRatings: "iso",
        Base.BrightnessValue: "brightness_stops",
        Base.WhiteBalance: "auto_white_balance",
    }
    unknown = {field for field, known in vars(found).items() if known is None}
    assert unknown == {names[tag]}


def test_the_first_of_several_sensitivities_counts(tmp_path):
    assert read_exposure(photo(tmp_path / "a.jpg", {Base.ISOSpeedRatings: (200, 400)})).iso == 200


def test_damaged_metadata_tells_nothing_and_a_broken_file_is_an_error(tmp_path):
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
        Exposure(shutter_s=30.0, iso=409600.0, auto_white_balance=True),
    ],
)
def test_what_is_written_is_read_again(tmp_path, exposure):
    Image.new("RGB", (16, 12)).save(tmp_path / "a.jpg", exif=exif_of(exposure))
    for name, value in vars(read_exposure(tmp_path / "a.jpg")).items():
        wanted = getattr(exposure, name)
        # fractions with denominators up to a million
        assert value == wanted or math.isclose(value, wanted, rel_tol=1e-2 if name == "shutter_s" else 1e-5)
