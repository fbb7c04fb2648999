"""Poses of another program beside photos: joined by name."""

from pathlib import Path

import format_files
import numpy as np
import pytest
import torch

from splatgraft import formats
from splatgraft.formats.captures import read_given_poses
from splatgraft.formats.captures.masks import find_photos


def poses(path: Path, names: list[str]) -> Path:
    """Write a transforms.json without its images."""
    pose, frames = np.eye(4), []
    for i, name in enumerate(names):
        pose[:3, 3] = (i, 0.1 * i, -4)
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    path.mkdir()
    return format_files.write_transforms(path, {"frames": frames, "w": 24, "h": 16}, frames=0)


def photos(folder: Path) -> Path:
    for i in range(4):
        format_files.write_photo(folder / f"{i:04d}.jpg", seed=i)
    return folder


@pytest.mark.parametrize("suffix", ["", ".jpg", ".JPG"])
def test_names_find_photos_with_and_without_suffix(tmp_path: Path, suffix: str) -> None:
    path = poses(tmp_path / "poses", [f"{i:04d}{suffix}" for i in (3, 0, 1, 7)])
    posed, without_pose, without_photo = read_given_poses(path, find_photos(photos(tmp_path / "photos")))
    assert [p.name for p in posed.image_paths] == ["0003.jpg", "0000.jpg", "0001.jpg"]
    assert without_pose == ["0002.jpg"]
    assert without_photo == [f"images/0007{suffix}"]
    assert posed.cameras.world_from_camera[1, :3, 3].tolist() == pytest.approx([1, 0.1, -4])


@pytest.mark.parametrize("kind", ["colmap", "nerf"])
def test_poses_beside_moved_photos_are_those_in_place(tmp_path: Path, kind: str) -> None:
    place, names = tmp_path / kind, ("0.jpg", "1.jpg", "2.jpg")
    for name in names:
        format_files.write_photo(place / "images" / name)
    if kind == "colmap":
        format_files.write_colmap(place / "sparse", names=names)
    else:
        frames = [{"file_path": f"images/{name}", "transform_matrix": np.eye(4).tolist()} for name in names]
        format_files.write_transforms(place, {"frames": frames, "w": 24, "h": 16})
    whole = formats.read_capture(place)
    (place / "images").rename(tmp_path / "moved")
    given, *_ = read_given_poses(place, find_photos(tmp_path / "moved"))
    assert torch.equal(given.cameras.world_from_camera, whole.cameras.world_from_camera)
    assert torch.equal(given.cameras.intrinsics, whole.cameras.intrinsics)
    assert torch.equal(given.points, whole.points)
    assert [path.parent.name for path in given.image_paths] == ["moved"] * 3


def test_poses_of_other_photos_two_poses_of_one_and_other_files_are_refused(tmp_path: Path) -> None:
    found = find_photos(photos(tmp_path / "photos"))
    path = poses(tmp_path / "poses", ["a.jpg", "b.jpg", "0000.jpg"])
    with pytest.raises(ValueError, match=r"3 photos .*found 1: .*named images/a\.jpg, the first photo 0000\.jpg"):
        read_given_poses(path, found)
    path = poses(tmp_path / "more", ["0000.jpg", "0000.png", "0001.jpg", "0002.jpg"])
    with pytest.raises(ValueError, match="expected one pose for the photo 0000, found 2"):
        read_given_poses(path, found)
    (tmp_path / "cameras.xml").write_text("<document/>")
    for source in ("cameras.xml", "photos"):
        with pytest.raises(ValueError, match=rf"{source}: expected poses .*found neither"):
            read_given_poses(tmp_path / source, found)
