"""transforms.json and cameras.json: Blender's and nerfstudio's keys, axes, round trips, refusals."""

import json
import math

import format_files
import numpy as np
import pytest
import torch
from PIL import Image

from splatgraft import formats
from splatgraft.core.cameras import look_at, pinhole


def test_opengl_axes_become_opencv_axes(tmp_path):
    # an OpenGL camera at (1, 2, 3) without rotation looks along -z with y up
    pose = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    frames = [{"file_path": "a.png", "transform_matrix": pose}]
    path = format_files.write_transforms(tmp_path, {"w": 24, "h": 16, "frames": frames})
    cameras = formats.read_cameras(path)
    assert cameras.centers.tolist() == [[1, 2, 3]]
    ahead, above = torch.tensor([1.0, 2, 2, 1]), torch.tensor([1.0, 3, 2, 1])
    assert (cameras.camera_from_world[0] @ ahead).tolist() == [0, 0, 1, 1]
    assert (cameras.camera_from_world[0] @ above).tolist() == [0, -1, 1, 1]  # y is down in the image


def test_blender_keys_and_missing_suffixes(tmp_path):
    path = format_files.write_transforms(tmp_path, {}, size=(40, 30))
    meta = json.loads(path.read_text())
    del meta["fl_x"]
    meta["camera_angle_x"] = 0.8
    for frame in meta["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    path.unlink()
    (tmp_path / "transforms_train.json").write_text(json.dumps(meta))
    capture = formats.read_capture(tmp_path)
    assert capture.cameras.names == ("0000.png", "0001.png")
    assert capture.cameras.sizes.tolist() == [[40, 30]] * 2
    focal = 20 / math.tan(0.4)
    assert torch.allclose(capture.cameras.intrinsics[0], torch.tensor([[focal, 0, 20], [0, focal, 15], [0, 0, 1]]))
    assert len(capture.points) == 0


def test_nerfstudio_keys_for_each_frame(tmp_path):
    path = format_files.write_transforms(tmp_path, {"w": 24, "h": 16, "applied_transform": [[1, 0, 0, 9]], "k1": 0.0})
    change(path, [1], {"fl_x": 30, "fl_y": 31, "cx": 11, "cy": 9, "k1": 0.1, "p2": 0.01})
    capture = formats.read_capture(path)
    assert capture.cameras.intrinsics[0].tolist() == [[20, 0, 12], [0, 20, 8], [0, 0, 1]]
    assert capture.distortions[0] is None
    assert capture.distortions[1].intrinsics.tolist() == [[30, 0, 11], [0, 31, 9], [0, 0, 1]]
    assert capture.distortions[1].coefficients.tolist() == [0.1, 0, 0, 0.01, 0]


def test_cameras_round_trip_bit_for_bit_and_none_are_not_written(tmp_path):
    poses = look_at(torch.randn(5, 3) * 3, torch.zeros(3), torch.tensor([0.0, 0, 1]))
    cameras = pinhole(poses, 33.3, width=24, height=16)
    cameras.intrinsics[2, 0, 2] += 0.123  # not shared by all
    formats.write_cameras(tmp_path / "y.json", cameras)
    back = formats.read_cameras(tmp_path / "y.json")
    assert torch.equal(back.world_from_camera, cameras.world_from_camera)
    assert torch.equal(back.intrinsics, cameras.intrinsics)
    assert torch.equal(back.sizes, cameras.sizes)
    assert back.names == cameras.names
    with pytest.raises(ValueError, match=r"y\.json: expected at least one camera"):
        formats.write_cameras(tmp_path / "y.json", cameras[[]])


@pytest.mark.parametrize(
    ("content", "factor"),
    [({"w": 24, "h": 16}, 1.0), ({"w": 24, "h": 16, "k1": -0.05, "k2": 0.01, "cx": 12.5}, 0.5)],
)
def test_capture_round_trip(tmp_path, content, factor):
    formats.write_points(tmp_path / "cloud.ply", torch.randn(7, 3), torch.randint(0, 256, (7, 3)) / 255)
    format_files.write_transforms(tmp_path, {**content, "ply_file_path": "cloud.ply"})
    for i in range(2):
        format_files.write_photo(tmp_path / "masks" / f"{i:04d}.png", seed=9 + i)
    capture = formats.read_capture(tmp_path).resized(factor)
    (tmp_path / "deeper" / "copy").mkdir(parents=True)
    formats.write_capture(tmp_path / "deeper" / "copy", capture)
    back = formats.read_capture(tmp_path / "deeper" / "copy")
    assert torch.equal(back.cameras.world_from_camera, capture.cameras.world_from_camera)
    # a distorted camera's pinhole is solved again, at the smaller size, in float64; then rounded to float32 near 30
    torch.testing.assert_close(back.cameras.intrinsics, capture.cameras.intrinsics, atol=4e-6, rtol=0)
    assert torch.equal(back.points, capture.points)
    assert torch.equal(back.point_colors, capture.point_colors)
    for i in range(2):
        # positions differ by 1e-6 px or so, times contrast 1 per pixel
        torch.testing.assert_close(back.image(i), capture.image(i), atol=2e-5, rtol=0)
        torch.testing.assert_close(back.mask(i), capture.mask(i), atol=2e-5, rtol=0)


def test_nearly_rigid_poses_are_made_rigid(tmp_path):
    rotation = np.round(format_files.rotation_and_quaternion(3)[0], 4)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    frames = [{"file_path": "a.png", "transform_matrix": pose.tolist()}]
    cameras = formats.read_cameras(format_files.write_transforms(tmp_path, {"w": 24, "h": 16, "frames": frames}))
    found = cameras.world_from_camera[0, :3, :3].double()
    assert (found.T @ found - torch.eye(3)).abs().max() < 1e-6  # float32
    assert np.abs(found.numpy() @ np.diag([1, -1, -1]) - rotation).max() < 1e-4  # loss by rounding


def test_cameras_json_of_the_original_code(tmp_path):
    rotation, _ = format_files.rotation_and_quaternion(1)
    entry = {"id": 0, "img_name": "a.jpg", "width": 24, "height": 16, "position": [1, 2, 3], "fx": 30.0, "fy": 31.0}
    (tmp_path / "cameras.json").write_text(json.dumps([{**entry, "rotation": rotation.tolist()}]))
    cameras = formats.read_cameras(tmp_path / "cameras.json")
    assert np.abs(cameras.world_from_camera[0, :3, :3].numpy() - rotation).max() < 1e-6
    assert cameras.centers.tolist() == [[1, 2, 3]]
    assert cameras.intrinsics[0].tolist() == [[30, 0, 12], [0, 31, 8], [0, 0, 1]]
    assert cameras.names == ("a.jpg",)


def test_links_keep_their_names_which_cannot_lead_out_of_a_folder(tmp_path):
    path = format_files.write_transforms(tmp_path / "capture", {"w": 24, "h": 16})
    first = tmp_path / "capture" / "images" / "0000.png"
    first.symlink_to(first.rename(tmp_path / "stored.png"))
    (tmp_path / "copy").mkdir()
    formats.write_capture(tmp_path / "copy", formats.read_capture(tmp_path / "capture"))
    assert formats.read_capture(tmp_path / "copy").cameras.names == ("0000.png", "0001.png")
    path.write_text(path.read_text().replace("images/0000.png", "../../a/..").replace("images/0001.png", "/etc/none"))
    assert formats.read_cameras(path).names == ("a", "none")


SCALED = (np.eye(4) * np.array([2, 2, 2, 1])).tolist()
MIRRORED = np.diag([1.0, 1, -1, 1]).tolist()


@pytest.mark.parametrize(
    ("frame", "content", "expected"),
    [
        ({"transform_matrix": SCALED}, {}, "axes of length 2, 2, 2"),
        ({"transform_matrix": MIRRORED}, {}, "determinant -1"),
        ({"transform_matrix": [[1, 2], [3]]}, {}, "transform_matrix"),
        ({"file_path": "images/0001.png"}, {}, "twice"),
        ({"mask_path": "no.png"}, {}, "no.png"),
        ({}, {"fl_x": -3}, "focal length above 0"),
        ({}, {"fl_x": "20"}, "'20'"),
        ({}, {"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({}, {"k4": 0.1}, "k4 = 0.1"),
        ({}, {"w": 24.5, "h": 16}, "24.5"),
        ({}, {"w": 24}, "'h'"),
        ({}, {"ply_file_path": "none.ply"}, "none.ply"),
        ({}, {"frames": []}, "a list of 'frames'"),
    ],
)
def test_refusals(tmp_path, frame, content, expected):
    path = format_files.write_transforms(tmp_path, content, frames=3)
    change(path, [0, 1] if content.get("frames", True) else [], frame)  # more than half
    with pytest.raises(ValueError, match=r"expected .*found") as caught:
        formats.read_capture(tmp_path)
    message = str(caught.value)
    assert str(tmp_path) in message
    assert expected in message
    assert "\n" not in message


def change(path, frames, keys):
    meta = json.loads(path.read_text())
    for index in frames:
        meta["frames"][index] |= keys
    path.write_text(json.dumps(meta))


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        ({"transform_matrix": [[float("nan")] * 4] * 4}, "finite"),
        ({"transform_matrix": None}, "transform_matrix"),
        ({"file_path": "images/9999.png"}, "images/9999.png"),
        ({"file_path": 3}, "file_path"),
        ({"fl_x": 0}, "focal length above 0"),
        ({"fl_x": 10, "k1": -3.0}, "distortion that can be undone"),
        ({"w": 48, "h": 48}, "found 24x16"),
        ({}, "images/0001.png"),
    ],
)
def test_one_frame_that_is_not_usable_is_left_out_and_named(tmp_path, frame, expected):
    path = format_files.write_transforms(tmp_path, {}, frames=3)
    change(path, [1], frame)
    if not frame:
        (tmp_path / "images/0001.png").write_bytes(b"\x89PNG\r\n\x1a\n cut short")
    capture = formats.read_capture(tmp_path)
    assert capture.cameras.names == ("0000.png", "0002.png")
    (left_out,) = capture.left_out
    assert expected in left_out.reason
    assert str(tmp_path) in left_out.reason
    assert not left_out.mask_only


def test_a_photo_posed_upright_is_read_upright(tmp_path):
    # stored on its side, with EXIF orientation 6: the upright picture is the stored one turned clockwise
    path = format_files.write_transforms(tmp_path, {"w": 24, "h": 16})
    pixels = np.random.default_rng(5).integers(0, 256, (24, 16, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "images/0000.png", exif=exif)
    upright = torch.from_numpy(np.rot90(pixels, -1).copy()).float() / 255
    capture = formats.read_capture(path)
    assert not capture.left_out
    assert torch.equal(capture.image(0), upright)
    # the same file, posed in its stored orientation: COLMAP ignores EXIF rotation
    path.write_text(path.read_text().replace('"w": 24, "h": 16', '"w": 16, "h": 24'))
    (tmp_path / "images/0001.png").unlink()
    stored = formats.read_capture(path)
    assert torch.equal(stored.image(0), torch.from_numpy(pixels).float() / 255)


def test_json_that_is_none(tmp_path):
    for text in ("", "{", "[]", '{"frames": 1e999}', "[" * 100_000):
        (tmp_path / "transforms.json").write_text(text)
        for read in (formats.read_capture, formats.read_cameras):
            with pytest.raises(ValueError, match=r"transforms\.json: expected .*found"):
                read(tmp_path / "transforms.json")


def test_transforms_count_before_colmap_whose_images_need_not_exist_for_cameras(tmp_path):
    format_files.write_colmap(tmp_path / "sparse" / "0")
    assert formats.read_cameras(tmp_path).names == ("a.png", "b.png")
    format_files.write_transforms(tmp_path, {})
    assert formats.read_capture(tmp_path).cameras.names == ("0000.png", "0001.png")
