"""COLMAP models: poses, points and layouts, compared with hand-packed files, and with pycolmap if installed."""

import struct

import format_files
import numpy as np
import pytest
import torch
from PIL import Image

from splatgraft import formats


def with_photos(root, names=("b.png", "a.png"), model="sparse/0", **options):
    poses = format_files.write_colmap(root / model, names=names, **options)
    for i, name in enumerate(names):
        format_files.write_photo(root / "images" / name, seed=i)
    return poses


@pytest.mark.parametrize("text", [False, True])
def test_poses_points_and_pictures(tmp_path, text):
    poses = with_photos(tmp_path, text=text)
    capture = formats.read_capture(tmp_path)
    assert capture.cameras.names == ("a.png", "b.png")  # by name, unlike the file's order
    for i, (rotation, translation) in enumerate(reversed(poses)):
        expected = np.concatenate([rotation, translation[:, None]], 1)
        found = capture.cameras.camera_from_world[i, :3].numpy()
        assert np.abs(found - expected).max() < 2e-6  # float32 of coordinates up to 4
    assert capture.cameras.intrinsics[0].tolist() == [[20, 0, 12], [0, 21, 8], [0, 0, 1]]
    assert capture.cameras.sizes.tolist() == [[24, 16]] * 2
    assert capture.points.tolist() == [[0, 1, -2], [0.5, 1, -2], [1, 1, -2]]
    assert torch.allclose(capture.point_colors[:, 0], torch.tensor([0, 10, 20]) / 255)
    with Image.open(tmp_path / "images" / "b.png") as image:
        assert torch.equal(capture.image(1), torch.from_numpy(np.array(image)).float() / 255)
    assert capture.distortions == ()
    assert torch.equal(formats.read_cameras(tmp_path).intrinsics, capture.cameras.intrinsics)


@pytest.mark.parametrize(
    ("model", "parameters", "matrix", "coefficients"),
    [
        ("SIMPLE_PINHOLE", (20.0, 12.0, 8.0), (20, 20, 12, 8), None),
        ("PINHOLE", (20.0, 21.0, 12.0, 8.0), (20, 21, 12, 8), None),
        ("SIMPLE_RADIAL", (20.0, 12.0, 8.0, 0.1), (20, 20, 12, 8), (0.1, 0, 0, 0, 0)),
        ("RADIAL", (20.0, 12.0, 8.0, 0.1, 0.02), (20, 20, 12, 8), (0.1, 0.02, 0, 0, 0)),
        ("OPENCV", (20.0, 21.0, 12.0, 8.0, 0.1, 0.02, 3e-3, 4e-3), (20, 21, 12, 8), (0.1, 0.02, 3e-3, 4e-3, 0)),
    ],
)
def test_camera_models(tmp_path, model, parameters, matrix, coefficients):
    with_photos(tmp_path, camera=(model, 24, 16, parameters))
    capture = formats.read_capture(tmp_path)
    k = capture.distortions[0].intrinsics if coefficients else capture.cameras.intrinsics[0]
    assert [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])] == list(matrix)
    if coefficients:
        assert tuple(capture.distortions[0].coefficients.tolist()) == coefficients


@pytest.mark.parametrize("layout", ["sparse", ".", "colmap/sparse/0"])
def test_layouts(tmp_path, layout):
    with_photos(tmp_path, model=layout)
    assert len(formats.read_capture(tmp_path)) == 2


def test_the_largest_model_counts_and_the_models_own_folder_finds_the_images(tmp_path):
    with_photos(tmp_path)
    assert len(formats.read_capture(tmp_path / "sparse" / "0")) == 2
    format_files.write_colmap(tmp_path / "sparse" / "1", names=("a.png", "b.png", "c.png"), text=True)
    format_files.write_colmap(tmp_path / "sparse" / "2", names=("a.png",))
    format_files.write_photo(tmp_path / "images" / "c.png")
    assert len(formats.read_capture(tmp_path)) == 3


def test_images_in_folders_keep_apart(tmp_path):
    with_photos(tmp_path, names=("left/0.png", "right/0.png"))
    capture = formats.read_capture(tmp_path)
    assert capture.cameras.names == ("left_0.png", "right_0.png")
    (tmp_path / "copy").mkdir()
    formats.write_capture(tmp_path / "copy", capture)
    assert formats.read_capture(tmp_path / "copy").cameras.names == capture.cameras.names


def refusal(path):
    with pytest.raises(ValueError, match="expected") as caught:
        formats.read_capture(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_refusals(tmp_path):
    (tmp_path / "empty").mkdir()
    assert "transforms.json" in refusal(tmp_path / "empty")
    assert "nothing there" in refusal(tmp_path / "none")
    with_photos(tmp_path / "a")
    for name in ("a", "b"):
        (tmp_path / f"a/images/{name}.png").unlink()
    assert "a.png" in refusal(tmp_path / "a")
    with_photos(tmp_path / "b", camera=("OPENCV_FISHEYE", 24, 16, (20.0, 21.0, 12.0, 8.0, 0.0, 0.0, 0.0, 0.0)))
    message = refusal(tmp_path / "b")
    assert "OPENCV_FISHEYE" in message
    assert "SIMPLE_RADIAL" in message
    with_photos(tmp_path / "c")
    for name in ("a", "b"):
        format_files.write_photo(tmp_path / f"c/images/{name}.png", 20, 20)
    assert "found 20x20" in refusal(tmp_path / "c")
    with_photos(tmp_path / "d")
    (tmp_path / "d/sparse/0/points3D.bin").unlink()
    assert "points3D" in refusal(tmp_path / "d")


def test_missing_images_are_left_out_and_named(tmp_path):
    with_photos(tmp_path, names=("a.png", "b.png", "c.png", "d.png"))
    (tmp_path / "images/b.png").unlink()
    capture = formats.read_capture(tmp_path)
    assert capture.cameras.names == ("a.png", "c.png", "d.png")
    assert [one.name for one in capture.left_out] == ["b.png"]
    for name in ("a", "c"):
        (tmp_path / f"images/{name}.png").unlink()
    message = refusal(tmp_path)
    assert "at least 50% of 4 images" in message
    assert "found 1" in message
    assert "a.png" in message


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_counts_are_not_believed(tmp_path, stem):
    with_photos(tmp_path)
    path = tmp_path / "sparse" / "0" / f"{stem}.bin"
    data = path.read_bytes()
    for count in (2**62, 2**40, 1000):
        path.write_bytes(struct.pack("<Q", count) + data[8:])
        assert path.name in refusal(tmp_path)
    for cut in (0, 5, 20, len(data) - 1):
        path.write_bytes(data[:cut])
        assert path.name in refusal(tmp_path)
    path.write_bytes(data + b"x")
    assert path.name in refusal(tmp_path)


def test_downsized_images_take_their_intrinsics_along(tmp_path):
    format_files.write_colmap(tmp_path / "sparse/0", camera=("PINHOLE", 4000, 3000, (3000.0, 3100.0, 2010.0, 1490.0)))
    for name in ("a.png", "b.png"):
        format_files.write_photo(tmp_path / "images" / name, 500, 375)
    cameras = formats.read_capture(tmp_path).cameras
    assert cameras.sizes.tolist() == [[500, 375]] * 2
    assert cameras.intrinsics[0].tolist() == [[375, 0, 251.25], [0, 387.5, 186.25], [0, 0, 1]]


def test_as_pycolmap_writes_it(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.camera_width, options.camera_height = 50, 64, 48
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_RADIAL, [60, 32, 24, 0.05]
    model = pycolmap.synthesize_dataset(options)
    for kind, write in (("text", model.write_text), ("binary", model.write_binary)):
        folder = tmp_path / kind
        (folder / "sparse" / "0").mkdir(parents=True)
        write(folder / "sparse" / "0")
        cameras = formats.read_cameras(folder)
        assert sorted(cameras.names) == sorted(image.name for image in model.images.values())
        for image in model.images.values():
            found = cameras.camera_from_world[cameras.names.index(image.name), :3].numpy()
            assert np.abs(found - image.cam_from_world().matrix()).max() < 1e-5  # float32 of coordinates up to 20
