"""What commands say of exposure metadata: that photos of one capture differ, and how the levels of two compare."""

import json
import math
from pathlib import Path

import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base
from shapes import surfels
from tiny_project import ball, photograph, plane

from splatgraft.capture.photos import working_copies, write_undistorted
from splatgraft.cli import main
from splatgraft.core.directions import even_directions
from splatgraft.core.distortion import Distortion
from splatgraft.core.exposure import Exposure
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.formats import write_gaussians
from splatgraft.formats.captures.exif import exif_of, read_exposure
from splatgraft.formats.placement import ObjectPlacement, Placement, write_placement


def exposed(capture: Path, exposures: list[Exposure]) -> None:
    """Replace the PNG files of a capture by JPEG files with exposure metadata, in turn."""
    text = (capture / "transforms.json").read_text()
    for i, path in enumerate(sorted((capture / "images").glob("*.png"))):
        exif = exif_of(exposures[i % len(exposures)])
        with Image.open(path) as image:
            image.save(path.with_suffix(".jpg"), quality=95, exif=exif)
        path.unlink()
        text = text.replace(f"images/{path.name}", f"images/{path.stem}.jpg")
    (capture / "transforms.json").write_text(text)
    assert all(frame["file_path"].endswith(".jpg") for frame in json.loads(text)["frames"])


def fixed(shutter_s: float) -> Exposure:
    return Exposure(shutter_s, 8.0, 100.0, auto_white_balance=False)


@pytest.mark.parametrize("command", ["capture", "reconstruct"])
def test_photos_of_different_exposure_are_named(tmp_path: Path, capsys, command: str):
    photograph(tmp_path / "photos", plane((0.5, 0.5, 0.5)), None)
    exposed(tmp_path / "photos", [Exposure(1 / 60, 1.8, 50.0, auto_white_balance=True), fixed(1 / 60)])
    more = ["--iterations", "2", "--budget", "100"] if command == "reconstruct" else []
    assert main([command, str(tmp_path / "photos"), "--out", str(tmp_path / "out"), *more]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(said) == 1
    assert said[0].startswith(f"warning: {tmp_path / 'photos'}: ")
    # f/8 to f/1.8 at ISO 100 and 50: 2 log2(8 / 1.8) - 1 = 3.3 stops
    assert "from 1/60 s f/8 ISO 100 to 1/60 s f/1.8 ISO 50, 3.3 stops apart" in said[0]
    assert "automatic white balance in 4 of 8 photos" in said[0]


@pytest.mark.parametrize("exposures", [[fixed(1 / 60)], [Exposure()]])
def test_fixed_exposure_and_photos_without_metadata_are_not_worth_a_line(tmp_path: Path, capsys, exposures):
    photograph(tmp_path / "photos", plane((0.5, 0.5, 0.5)), None)
    exposed(tmp_path / "photos", exposures)
    assert main(["capture", str(tmp_path / "photos"), "--out", str(tmp_path / "out")]) == 0
    assert "warning" not in capsys.readouterr().err


def test_undistorted_photos_keep_the_exposure_and_no_other_metadata(tmp_path: Path):
    exif = exif_of(fixed(1 / 60))
    exif[Base.Make] = "Maker"
    Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg", exif=exif)
    (copy,) = working_copies([tmp_path / "a.jpg"], tmp_path / "copies", 1600)
    matrix = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]], dtype=torch.float64)
    lens = Distortion(matrix, torch.tensor([0.01, 0, 0, 0, 0], dtype=torch.float64), (40, 30))
    write_undistorted(copy, tmp_path / "b.jpg", lens)
    assert read_exposure(tmp_path / "b.jpg") == read_exposure(tmp_path / "a.jpg")
    with Image.open(tmp_path / "b.jpg") as image:
        assert set(image.getexif()) == {IFD.Exif}


def relit_report(folder: Path, exposures: dict[str, list[Exposure]]) -> list[str]:
    """The lines of light.txt of a ball that is moved between two rooms of one picture."""

    def room() -> Gaussians:
        away = 20 * even_directions(2000)
        return concatenate([plane((0.5, 0.5, 0.5)), surfels(away, -away, width=1.0, srgb=0.5)])

    photograph(folder / "target", room(), None)
    photograph(folder / "source", room(), ball())
    for name, photos in exposures.items():
        exposed(folder / name, photos)
    write_gaussians(folder / "room.ply", room())
    write_gaussians(folder / "own.ply", ball())
    here = Similarity(1.0, torch.eye(3), torch.zeros(3))
    write_placement(folder / "placement.json", Placement((ObjectPlacement(here, folder / "own.ply"),)))
    words = ["--target", "room.ply", "--surroundings", "room.ply", "--placement", "placement.json"]
    words += ["--cameras", "target/transforms.json", "--object-cameras", "source/transforms.json", "--out", "relit"]
    paths = [word if word.startswith("--") else str(folder / word) for word in words]
    assert main(["relight", *paths]) == 0
    return (folder / "relit" / "light.txt").read_text().splitlines()


def test_relight_compares_the_levels_of_both_captures(tmp_path: Path):
    # equal pictures at an eighth of the exposure show eight times the light
    exposures = {"target": [fixed(1 / 800)], "source": [fixed(1 / 100)]}
    lines = [line for line in relit_report(tmp_path, exposures) if "by the exposure of the photos" in line]
    assert len(lines) == 1
    by_photos, by_light = (float(words.split()[-1]) for words in lines[0].split(" stops brighter")[:2])
    # the source's photos show the ball too, which is darker: a tenth of a stop or two
    assert by_photos == pytest.approx(3, abs=0.3)
    # the same ratio is told in lux, rounded to two digits each
    words = lines[0].replace(",", "").split()
    new, old = float(words[words.index("lux") - 1].lstrip("(")), float(words[words.index("at", words.index("lux")) - 1])
    assert by_light == pytest.approx(math.log2(new / old), abs=0.2)


def test_relight_says_nothing_of_exposure_where_one_capture_has_no_metadata(tmp_path: Path):
    lines = relit_report(tmp_path, {"target": [fixed(1 / 800)]})
    assert lines
    assert not [line for line in lines if "exposure" in line]
