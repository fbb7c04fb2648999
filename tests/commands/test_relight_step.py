"""`relight` on explicit paths: which objects lose the old light, pictures of the light, and messages on exposure."""

import json
import math
from datetime import UTC, datetime
from pathlib import Path

import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base
from shapes import surfels
from tiny_project import ball, photograph, plane

from splatgraft.capture.photos import working_copies, write_undistorted
from splatgraft.cli import main
from splatgraft.core.clock_sun import ClockSun, SunCandidate
from splatgraft.core.directions import even_directions
from splatgraft.core.distortion import Distortion
from splatgraft.core.exposure import Exposure
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import read_rgb
from splatgraft.core.similarity import Similarity
from splatgraft.folders.clock_sun import write_clock_sun
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.formats.captures.exif import exif_of, read_exposure
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement


def room(gray: float) -> Gaussians:
    """Return a plane inside a large sphere."""
    away = 20 * even_directions(2000)
    return concatenate([plane((gray, gray, gray)), surfels(away, -away, width=1.0, srgb=gray)])


def relit(
    folder: Path,
    rooms: tuple[Gaussians, Gaussians],
    objects: dict[str, tuple[Gaussians, list[Similarity]]],
    *more: str,
    sun: ClockSun | None = None,
) -> Path:
    """Return the result of `relight` for a target, a source around a ball, and objects with their places by file."""
    for name, scene, thing in (("target", rooms[0], None), ("source", rooms[1], ball())):
        photograph(folder / name, scene, thing)
        write_gaussians(folder / f"{name}.ply", scene)
    if sun is not None:
        write_clock_sun(folder / "target", sun)
    for name, (thing, _) in objects.items():
        write_gaussians(folder / name, thing)
    placed = [ObjectPlacement(move, folder / name) for name, (_, moves) in objects.items() for move in moves]
    write_placement(folder / "placement.json", Placement(tuple(placed)))
    paths = {"target": "target.ply", "surroundings": "source.ply", "placement": "placement.json", "taken": "own.ply"}
    paths |= {"cameras": "target/transforms.json", "object-cameras": "source/transforms.json", "out": "relit"}
    words = [word for name, path in paths.items() for word in (f"--{name}", str(folder / path))]
    # the floor is split at shadows for two thirds of the time, and no test here looks at a shadow
    assert main(["relight", *words, "--most-added", "0", *more]) == 0
    return folder / "relit"


def at(x: float, y: float, scale: float = 0.5) -> Similarity:
    return Similarity(scale, torch.eye(3), torch.tensor([x, y, 0.0]))


@pytest.mark.long
def test_copies_lose_the_same_old_light_and_a_strange_object_keeps_its_own(tmp_path: Path):
    # the copies stand where as much of the target is around them
    objects = {"strange.ply": (ball(), [at(0, 0.5)]), "own.ply": (ball(), [at(-0.2, 0), at(0.2, 0)])}
    found = relit(tmp_path, (room(0.8), room(0.25)), objects)
    notes = (found / "light.txt").read_text().splitlines()
    assert "The old light of object 1 is unknown: the object keeps its mean brightness." in notes
    old = [next(note for note in notes if f"old place of object {number}:" in note) for number in (2, 3)]
    assert old[0].replace("object 2", "object 3") == old[1]
    strange, one, other = read_gaussians(found / "scene.ply").sh[-3 * ball().count :, 0].chunk(3)
    kept, lost, also_lost = (float((colors - ball().sh[:, 0]).mean()) for colors in (strange, one, other))
    # the target is bright, the source was dark; another place 0.4 away changes little
    assert lost > 0.05
    assert also_lost == pytest.approx(lost, rel=0.15)
    # the mean is kept in linear light, not in sRGB
    assert abs(kept) < 0.2 * lost


def test_the_lights_of_both_places_are_drawn_past_an_object_without_gaussians(tmp_path: Path, capsys):
    nothing = ball().select(torch.zeros(0, dtype=torch.int64))
    objects = {"nothing.ply": (nothing, [at(0, 0)]), "own.ply": (ball(), [at(0, 0)])}
    sun = ClockSun(
        (SunCandidate(datetime(2019, 6, 12, 16, 46, tzinfo=UTC), "GPS", 44.0),), (0.0, 0.0, 1.0), 5.0, 5.0, "up"
    )
    found = relit(tmp_path, (room(0.8), room(0.25)), objects, sun=sun)
    # the time is printed, but it is not in the report, which can be shared
    assert "12 June 2019, 16:46 UTC by GPS: sun 44.0 degrees high" in " ".join(capsys.readouterr().err.split())
    assert "2019" not in (found / "light.txt").read_text()
    drawn = {path.name: read_rgb(path) for path in found.glob("*.png")}
    # numbered as the placement's objects, as in the report
    assert "At the old place of object 2" in (found / "light.txt").read_text()
    assert sorted(drawn) == ["light.png", "source_light_2.png"]
    assert {picture.shape for picture in drawn.values()} == {(256, 768, 3)}
    assert float(drawn["light.png"].mean()) > float(drawn["source_light_2.png"].mean()) + 0.05


def exposed(capture: Path, exposures: list[Exposure]) -> None:
    """Replace the PNG files of a capture by JPEG files with exposure metadata, in turn."""
    text = (capture / "transforms.json").read_text()
    for i, path in enumerate(sorted((capture / "images").glob("*.png"))):
        with Image.open(path) as image:
            image.save(path.with_suffix(".jpg"), quality=95, exif=exif_of(exposures[i % len(exposures)]))
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


def test_a_sun_through_a_point_and_its_shadow_is_the_light_and_the_report_says_so(tmp_path: Path) -> None:
    points = ["--sun-through", "0.5", "0", "0.4", "0.1", "0", "0", "0.5", "0.02", "0.4", "0.1", "0.02", "0"]
    out = relit(tmp_path, (room(0.5), room(0.5)), {"own.ply": (ball(), [at(0, 0)])}, *points)
    sources = json.loads((out / "light.json").read_text())["sources"]
    # the floor of the room shows no shadow whose edge gives its strength
    assert [source["name"] for source in sources if "sun" in source["name"]] == [
        "sun set by hand, its strength estimated"
    ]
    assert sources[0]["direction"] == pytest.approx([math.sqrt(0.5), 0, math.sqrt(0.5)], abs=1e-3)
    assert "sun set by hand, its strength estimated 45 degrees high" in (out / "light.txt").read_text()
