"""Poses of another program beside photos: joined by name; the lens is that of the program's manual."""

from pathlib import Path

import cv2
import format_files
import numpy as np
import pytest
import torch

from splatgraft import formats
from splatgraft.formats.captures.given_poses import read_given_poses
from splatgraft.formats.captures.masks import find_photos

LENS = {"f": 20.0, "cx": 0.5, "cy": -0.25, "b1": 0.5, "k1": 0.05, "k2": 0.01, "k3": -0.02, "p1": 0.003, "p2": -0.002}


def metashape(path: Path, labels: list[str], lens: dict[str, float] = LENS) -> Path:
    """Cameras in a group, the last of them without a pose."""
    pose, cameras = np.eye(4), ""
    for i, label in enumerate([*labels, "unaligned"]):
        pose[:3, 3] = (i, 0.1 * i, -4)
        transform = f"<transform>{' '.join(map(str, pose.ravel()))}</transform>" if i < len(labels) else ""
        cameras += f'<camera id="{i}" sensor_id="0" label="{label}">{transform}</camera>'
    calibration = "".join(f"<{key}>{value}</{key}>" for key, value in lens.items())
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        '<sensor id="0" label="unknown" type="frame"><resolution width="24" height="16"/>'
        f'<calibration type="frame" class="adjusted"><resolution width="24" height="16"/>{calibration}</calibration>'
        f"</sensor></sensors><cameras><group>{cameras}</group></cameras></chunk></document>"
    )
    return path


def photos(folder: Path) -> Path:
    for i in range(4):
        format_files.write_photo(folder / f"{i:04d}.jpg", seed=i)
    return folder


@pytest.mark.parametrize("suffix", ["", ".jpg", ".JPG"])
def test_metashape_labels_find_photos_with_and_without_suffix(tmp_path: Path, suffix: str) -> None:
    path = metashape(tmp_path / "cameras.xml", [f"{i:04d}{suffix}" for i in (3, 0, 1, 7)])
    given = read_given_poses(path, find_photos(photos(tmp_path / "photos")))
    assert [p.name for p in given.posed.image_paths] == ["0003.jpg", "0000.jpg", "0001.jpg"]
    assert given.without_pose == ("0002.jpg",)
    assert given.without_photo == (f"0007{suffix}",)
    assert given.posed.cameras.world_from_camera[1, :3, 3].tolist() == pytest.approx([1, 0.1, -4])


def test_metashape_lens_projects_as_its_manual_says(tmp_path: Path) -> None:
    path = metashape(tmp_path / "cameras.xml", ["0000", "0001", "0002"])
    lens = read_given_poses(path, find_photos(photos(tmp_path / "photos"))).posed.distortions[0]
    assert lens is not None
    x, y = 0.3, -0.2
    r = x * x + y * y
    radial = 1 + LENS["k1"] * r + LENS["k2"] * r**2 + LENS["k3"] * r**3
    u = x * radial + LENS["p1"] * (r + 2 * x * x) + 2 * LENS["p2"] * x * y
    v = y * radial + LENS["p2"] * (r + 2 * y * y) + 2 * LENS["p1"] * x * y
    expected = (12 + LENS["cx"] + u * (LENS["f"] + LENS["b1"]), 8 + LENS["cy"] + v * LENS["f"])
    point, matrix = np.array([[[x, y, 1.0]]]), lens.intrinsics.numpy()
    found, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, lens.coefficients.numpy())
    assert found.ravel() == pytest.approx(expected, abs=1e-9)  # float64 rounding


@pytest.mark.parametrize(
    ("lens", "message"),
    [(LENS | {"k4": 0.1}, "k4 = 0.1"), ({"k1": 0.1}, "found no f")],
    ids=["fourth radial coefficient", "no focal length"],
)
def test_a_lens_that_is_not_supported_is_refused(tmp_path: Path, lens: dict[str, float], message: str) -> None:
    path = metashape(tmp_path / "cameras.xml", ["0000", "0001", "0002"], lens)
    with pytest.raises(ValueError, match=message):
        read_given_poses(path, find_photos(photos(tmp_path / "photos")))


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
    given = read_given_poses(place, find_photos(tmp_path / "moved")).posed
    assert torch.equal(given.cameras.world_from_camera, whole.cameras.world_from_camera)
    assert torch.equal(given.cameras.intrinsics, whole.cameras.intrinsics)
    assert torch.equal(given.points, whole.points)
    assert [path.parent.name for path in given.image_paths] == ["moved"] * 3


def test_poses_of_other_photos_are_refused_with_both_names(tmp_path: Path) -> None:
    path = metashape(tmp_path / "cameras.xml", ["a", "b", "0000"])
    with pytest.raises(ValueError, match=r"at least 3 photos .*found 1: .*named a, the first photo 0000\.jpg"):
        read_given_poses(path, find_photos(photos(tmp_path / "photos")))


@pytest.mark.parametrize("text", ["<document>", "<document/>", "poses"])
def test_other_files_are_no_poses(tmp_path: Path, text: str) -> None:
    found = find_photos(photos(tmp_path / "photos"))
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(ValueError, match=r"cameras\.xml: expected .*found"):
        read_given_poses(tmp_path / "cameras.xml", found)
    with pytest.raises(ValueError, match=r"photos: expected .*found"):
        read_given_poses(tmp_path / "photos", found)


def realityscan(path: Path, rows: list[dict[str, object]], *, without: str = "") -> Path:
    names = ["#name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2"]
    given: list[dict[str, object]] = [
        {**dict.fromkeys(names, 0.0), "#name": f"000{i}.jpg", "x": i, "f": 36.0, **row} for i, row in enumerate(rows)
    ]
    columns = [name for name in names if name != without]
    lines = [",".join(columns), *(",".join(str(row[name]) for name in columns) for row in given)]
    path.write_text("\ufeff" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("angles", "ahead", "top"),
    [
        # looks down, its top to the north (y)
        ({}, (0, 0, -1), (0, 1, 0)),
        # heading is clockwise from above: its top to the east (x)
        ({"heading": 90}, (0, 0, -1), (1, 0, 0)),
        # pitched up to the horizon: looks north, its top up
        ({"pitch": 90}, (0, 1, 0), (0, 0, 1)),
        ({"heading": 90, "pitch": 90}, (1, 0, 0), (0, 0, 1)),
        # roll about its own y, which is its top: looks west
        ({"roll": 90}, (-1, 0, 0), (0, 1, 0)),
    ],
)
def test_realityscan_angles_are_those_of_an_aeroplane(
    tmp_path: Path, angles: dict[str, object], ahead: tuple[int, ...], top: tuple[int, ...]
) -> None:
    path = realityscan(tmp_path / "cameras.csv", [angles, {}, {}, {}])
    posed = read_given_poses(path, find_photos(photos(tmp_path / "photos"))).posed
    pose = posed.cameras.world_from_camera[0]
    assert pose[:3, 2].tolist() == pytest.approx(ahead, abs=1e-6)
    assert (-pose[:3, 1]).tolist() == pytest.approx(top, abs=1e-6)
    assert posed.cameras.world_from_camera[2, :3, 3].tolist() == [2, 0, 0]


def test_realityscan_lens_is_in_shares_of_the_longer_side(tmp_path: Path) -> None:
    row: dict[str, object] = {"f": 27.0, "px": 0.05, "py": -0.02, "k1": 0.05, "k2": 0.01, "k3": -0.02}
    row |= {"t1": 0.003, "t2": -0.002}
    path = realityscan(tmp_path / "cameras.csv", [row, row, row, row])
    lens = read_given_poses(path, find_photos(photos(tmp_path / "photos"))).posed.distortions[0]
    assert lens is not None
    width, height = lens.size
    longer = max(width, height)
    focal = 27 / 36 * longer
    expected = [[focal, 0, width / 2 + 0.05 * longer], [0, focal, height / 2 - 0.02 * longer], [0, 0, 1]]
    assert lens.intrinsics.tolist() == pytest.approx(np.array(expected))
    assert lens.coefficients.tolist() == [0.05, 0.01, 0.003, -0.002, -0.02]


@pytest.mark.parametrize(
    ("row", "without", "message"),
    [
        ({}, "heading", "expected RealityScan's CSV with columns #name, x, y, .*found no heading"),
        ({"pitch": "nan"}, "", "expected a finite number as pitch of 0000.jpg, found 'nan'"),
        ({"k4": 0.1}, "", "expected f above 0 and k4 of 0 for 0000.jpg, found f = 36, k4 = 0.1"),
        ({"f": 0}, "", "expected f above 0 and k4 of 0"),
    ],
)
def test_realityscan_files_that_cannot_be_used(
    tmp_path: Path, row: dict[str, object], without: str, message: str
) -> None:
    path = realityscan(tmp_path / "cameras.csv", [row, {}, {}, {}], without=without)
    with pytest.raises(ValueError, match=message):
        read_given_poses(path, find_photos(photos(tmp_path / "photos")))
