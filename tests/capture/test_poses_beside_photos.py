"""Capture, --poses: photos in one place, poses of another program in another."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatgraft.cli import main
from splatgraft.formats import read_capture


def write_photos(folder: Path, count: int) -> None:
    folder.mkdir(parents=True)
    for i in range(count):
        pixels = np.random.default_rng(i).integers(0, 256, (16, 24, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{i}.jpg")


def write_poses(folder: Path, names: list[str]) -> Path:
    folder.mkdir()
    frames = []
    for i, name in enumerate(names):
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append({"file_path": f"somewhere/{name}", "transform_matrix": pose.tolist()})
    path = folder / "transforms.json"
    path.write_text(json.dumps({"w": 24, "h": 16, "fl_x": 20.0, "frames": frames}))
    return path


def test_poses_and_masks_come_together_and_what_has_no_partner_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_photos(tmp_path / "mine" / "images", 10)
    mask = Image.new("L", (24, 16), 255)
    mask.paste(0, (0, 0, 12, 16))
    mask.save(tmp_path / "mine" / "images" / "1_mask.png")
    posed = [0, 1, *range(3, 10)]
    poses = write_poses(tmp_path / "theirs", [*(f"{i}.png" for i in posed), "10.png"])
    for given in (poses, poses.parent):
        out = tmp_path / f"capture-{given.stem}"
        assert main(["capture", str(tmp_path / "mine"), "--poses", str(given), "--out", str(out)]) == 0
        found = read_capture(out)
        assert [path.name for path in found.image_paths] == [f"{i}.jpg" for i in posed]
        assert found.cameras.world_from_camera[:, 0, 3].tolist() == list(range(9))
        assert [path and path.name for path in found.mask_paths] == [None, "1_mask.png", *[None] * 7]
        said = capsys.readouterr().err
        for expected in (
            "poses of 9 of 10 photos",
            "without a pose, left out: 2.jpg",
            "10.png",
            "1 of 10 photos have masks",
        ):
            assert expected in said


def test_masks_of_photos_without_poses_that_tell_nothing_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_photos(tmp_path / "mine" / "images", 10)
    half = Image.new("L", (24, 16), 255)
    half.paste(0, (0, 0, 12, 16))
    masks = {"0": half, "1": Image.new("L", (24, 16)), "2": Image.new("L", (24, 16), 255), "3": half.resize((16, 16))}
    for name, mask in masks.items():
        mask.save(tmp_path / "mine" / "images" / f"{name}_mask.png")
    poses = write_poses(tmp_path / "theirs", [f"{i}.png" for i in range(10)])
    assert main(["capture", str(tmp_path / "mine"), "--poses", str(poses), "--out", str(tmp_path / "out")]) == 0
    found = read_capture(tmp_path / "out")
    assert [path and path.name for path in found.mask_paths] == ["0_mask.png", *[None] * 9]
    said = capsys.readouterr().err
    assert "the mask of 1.jpg, the mask of 2.jpg, the mask of 3.jpg" in said
    assert "1_mask.png: expected white where the object is, found black all over" in said
    assert "2_mask.png: expected white where the object is, found white all over" in said
    assert "3_mask.png: expected 24x16 px" in said


def test_poses_beside_a_video_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = write_poses(tmp_path / "theirs", ["0.png"])
    (tmp_path / "video.mp4").touch()
    assert main(["capture", str(tmp_path / "video.mp4"), "--poses", str(poses), "--out", str(tmp_path / "out")]) == 2
    assert "expected a folder of photos beside --poses" in capsys.readouterr().err
