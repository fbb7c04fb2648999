"""The commands `scale` and `compose`: a size in metres is stored with the captures and used; places named by hand."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_project import ball, photograph, plane

from splatgraft.cli import main
from splatgraft.core.distortion import Distortion
from splatgraft.core.gaussians import concatenate
from splatgraft.formats import read_capture, write_gaussians
from splatgraft.project.metric_scale import read_scale
from splatgraft.project.placement import read_placement


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    photograph(tmp_path / "source", plane((0.3, 0.5, 0.3)), ball())
    photograph(tmp_path / "target", plane((0.5, 0.45, 0.6)), None)
    write_gaussians(tmp_path / "target.ply", plane((0.5, 0.45, 0.6)))
    write_gaussians(tmp_path / "object.ply", ball())
    return tmp_path


def composed(root: Path, *words: str) -> int:
    paths = {"target": "target.ply", "object": "object.ply", "out": "composite"}
    paths |= {"cameras": "target/transforms.json", "object-cameras": "source/transforms.json"}
    return main(["compose", *(x for key, path in paths.items() for x in (f"--{key}", str(root / path))), *words])


def placed(root: Path):
    return read_placement(root / "composite" / "placement.json").objects[0].target_from_object


def pixel(root: Path, side: str, index: int, point: tuple[float, float, float]) -> str:
    cameras = read_capture(root / side).cameras
    pose = cameras.camera_from_world[index]
    x, y, z = (cameras.intrinsics[index] @ (pose[:3, :3] @ torch.tensor(point) + pose[:3, 3])).tolist()
    return f"{Path(cameras.names[index]).stem}:{x / z},{y / z}"


def test_sizes_in_metres_of_both_captures_give_the_object_its_size(captures: Path, capsys) -> None:
    assert composed(captures) == 0
    said = capsys.readouterr().err
    assert "a guess" in said
    assert "splatgraft scale" in said
    guessed = placed(captures).scale
    assert main(["scale", str(captures / "source"), "--factor", "0.5"]) == 0
    assert composed(captures) == 0
    said = capsys.readouterr().err
    assert "cm tall in its capture (the factor that was given)" in said
    assert "a guess" in said
    assert placed(captures).scale == pytest.approx(guessed)
    ends = [
        " ".join(pixel(captures, "target", index, point) for index in (0, 2, 3))
        for point in ((0.5, 0.0, 0.0), (-0.5, 0.2, 0.0))
    ]
    assert main(["scale", str(captures / "target"), "--length", "2", "--ends", *ends]) == 0
    found = read_scale(captures / "target")
    assert found is not None
    # two metres over the 1.02 units between the points
    assert found.metres_per_unit == pytest.approx(2 / 1.04**0.5, rel=1e-3)
    capsys.readouterr()
    assert composed(captures) == 0
    assert "as large as it was" in capsys.readouterr().err
    assert placed(captures).scale == pytest.approx(0.5 / found.metres_per_unit, rel=1e-5)
    # the user's scale overrides the stored one
    assert composed(captures, "--scale", "0.7") == 0
    assert placed(captures).scale == pytest.approx(0.7)


def test_the_scale_of_a_step_s_capture_is_kept_beside_it(captures: Path) -> None:
    project = captures / "project"
    assert main(["capture", str(captures / "source"), "--out", str(project / "source" / "capture")]) == 0
    assert main(["scale", str(project / "source" / "capture"), "--factor", "2"]) == 0
    assert json.loads((project / "source" / "scale.json").read_text())["metres_per_unit"] == 2
    assert main(["capture", str(captures / "source"), "--out", str(project / "source" / "capture")]) == 0
    found = read_scale(project / "source" / "capture" / "transforms.json")
    assert found is not None
    assert found.metres_per_unit == 2


def test_a_place_is_named_by_a_pixel_or_a_point(captures: Path, capsys) -> None:
    wanted = (0.4, -0.3, 0.0)
    assert composed(captures, "--scale", "0.5", "--on", pixel(captures, "target", 1, wanted)) == 0
    foot = placed(captures).points(torch.tensor([0.0, 0, 0.3]))
    # a surface of discs of deviation 0.12 is this uncertain along a ray that meets it at 40 degrees
    assert (foot[:2] - torch.tensor(wanted[:2])).norm() < 0.15
    assert composed(captures, "--scale", "0.5", "--point", "0.4", "-0.3", "0.2") == 0
    foot = placed(captures).points(torch.tensor([0.0, 0, 0.3]))
    assert (foot[:2] - torch.tensor(wanted[:2])).norm() < 0.1
    for words, message in (
        (("--on", "view_0001.png:1,2", "--point", "0", "0", "0"), "expected --point or --on, found both"),
        (("--on", "nowhere.png:1,2"), "--on: expected one picture called nowhere.png, found 0 of 8"),
        (("--on", "1,2"), "--on: expected"),
    ):
        capsys.readouterr()
        assert composed(captures, *words) == 2
        assert message in capsys.readouterr().err


def test_what_cannot_be_a_scale_is_said(captures: Path, capsys) -> None:
    for words, message in (
        ((), "expected one of --factor, --marker and --length with --ends, found none"),
        (("--factor", "1", "--marker", "0.1"), "found --factor, --marker"),
        (("--length", "1"), "found --length"),
        (("--factor", "0"), "--factor: expected metres above 0, found 0"),
        (("--marker", "0.1"), "expected an AprilTag or ArUco marker in two images, found 0 in one"),
        (("--length", "1", "--ends", "view_0000:1,2", "view_0001:1,2"), "expected the point in two images, or a scene"),
    ):
        capsys.readouterr()
        assert main(["scale", str(captures / "target"), *words]) == 2
        assert message in capsys.readouterr().err
    (captures / "target" / "scale.json").write_text('{"metres_per_unit": -1}')
    assert composed(captures) == 2
    assert "scale.json: expected metres_per_unit above 0, found -1" in capsys.readouterr().err


def test_clicks_in_a_file_select_the_object(captures: Path, capsys) -> None:
    write_gaussians(captures / "scene.ply", concatenate([plane((0.3, 0.5, 0.3)), ball()]))
    first, second = (pixel(captures, "source", index, (0.0, 0.0, 0.3)) for index in (0, 3))
    name, _, click = first.partition(":")
    prompts = captures / "prompts.toml"
    prompts.write_text(f"[{name}]\ninside = [[{click}]]\n[{second.partition(':')[0]}]\nbox = [8, 2, 40, 32]\n")
    words = ["segment", "--scene", str(captures / "scene.ply"), "--capture", str(captures / "source")]
    words += ["--solidify", "0"]
    words += ["--out", str(captures / "object"), "--mask-source", "grabcut", "--prompts", str(prompts)]
    assert main(words) == 0
    selection = torch.from_numpy(np.load(captures / "object" / "selection.npy"))
    # the ball's 80 Gaussians come last; a third of it is near the plane, which its large Gaussians reach
    assert selection[-80:].float().mean() > 0.6
    assert selection[:-80].float().mean() < 0.1
    prompts.write_text("[view_0009]\ninside = [[24, 16]]\n")
    capsys.readouterr()
    assert main(words) == 2
    assert "prompts.toml: expected one picture called view_0009, found 0 of 8" in capsys.readouterr().err


def test_clicks_on_a_distorted_photo_are_undistorted() -> None:
    matrix = torch.tensor([[130.0, 0, 83], [0, 134, 57], [0, 0, 1]], dtype=torch.float64)
    lens = Distortion(matrix, torch.tensor([-0.15, 0.03, 0, 0, 0], dtype=torch.float64), (160, 120))
    pinhole = torch.from_numpy(lens.pinhole()).float()
    picture = torch.zeros(120, 160, 3)
    picture[100:103, 140:143] = 1
    seen = lens.undistort(picture, pinhole, width=160, height=120)[..., 0]
    rows, columns = torch.meshgrid(torch.arange(120) + 0.5, torch.arange(160) + 0.5, indexing="ij")
    middle = torch.stack([(columns * seen).sum(), (rows * seen).sum()]) / seen.sum()
    found = lens.undistort_points(torch.tensor([[141.5, 101.5]]), pinhole)[0]
    # a spot of 3 px, blurred by the resampling
    assert torch.allclose(found, middle, atol=0.3)
    assert lens.undistort_points(torch.zeros(0, 2), pinhole).shape == (0, 2)
