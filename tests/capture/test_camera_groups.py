"""Capture, photos: which photos share a camera in structure from motion."""

from pathlib import Path

import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from splatgraft.capture.photos import camera_groups, working_copies


def photo(
    path: Path, size: tuple[int, int] = (40, 30), *, model: str | None = None, focal: float | None = None
) -> Path:
    exif = Image.Exif()
    if model is not None:
        exif[Base.Make], exif[Base.Model] = "Maker", model
    if focal is not None:
        exif.get_ifd(IFD.Exif)[Base.FocalLength] = focal
    Image.new("RGB", size).save(path, exif=exif)
    return path


def groups(folder: Path, photos: list[Path], *, shared: bool = True) -> list[list[str]]:
    return camera_groups(working_copies(photos, folder / "copies", 1600), shared)


def test_equal_photos_without_exif_share_one_camera(tmp_path: Path) -> None:
    photos = [photo(tmp_path / f"{i}.jpg") for i in range(3)]
    assert groups(tmp_path, photos) == [["0.jpg", "1.jpg", "2.jpg"]]


@pytest.mark.parametrize(
    "other", [{"size": (36, 30)}, {"model": "Other"}, {"focal": 70.0}], ids=["size", "model", "focal length"]
)
def test_an_odd_photo_has_a_camera_of_its_own_and_the_others_still_share(tmp_path: Path, other: dict) -> None:
    usual = {"size": (40, 30), "model": "Usual", "focal": 35.0}
    photos = [photo(tmp_path / f"{i}.jpg", **usual) for i in range(2)]
    photos.insert(1, photo(tmp_path / "odd.jpg", **(usual | other)))
    assert groups(tmp_path, photos) == [["0.jpg", "1.jpg"], ["odd.jpg"]]


def test_each_photo_has_a_camera_where_that_is_asked_for(tmp_path: Path) -> None:
    photos = [photo(tmp_path / f"{i}.jpg") for i in range(3)]
    assert groups(tmp_path, photos, shared=False) == [["0.jpg"], ["1.jpg"], ["2.jpg"]]
