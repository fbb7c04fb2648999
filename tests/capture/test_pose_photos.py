"""Capture, structure from motion: errors that help, and poses of made-up photos whose true poses are known."""

import math
from dataclasses import replace
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
import torch

from splatgraft.capture import PoseOptions, Unposed, pose_photos, structure_from_motion
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.images import write_image
from splatgraft.formats.captures.masks import PhotoFiles

UP = torch.tensor([0.0, 0, 1])


def photo_paths(folder, count):
    folder.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(0)
    paths = [folder / f"{i:02d}.png" for i in range(count)]
    for path in paths:
        write_image(path, torch.rand(30, 40, 3, generator=generator))
    return PhotoFiles(tuple(paths))


def model_of(poses, focal=50.0, points=()):
    """What the COLMAP process answers."""
    return {
        "models": 1,
        "method": "global",
        "explained": 0.8,
        "seconds": {"features": 1.0, "matching": 2.0, "mapping": 0.5},
        "cpu_seconds": {"features": 1.0, "matching": 2.0, "mapping": 0.5},
        "unposed": [{"name": f"{i:02d}.jpg", "features": 900, "matches": 12} for i in range(len(poses), 8)],
        "mean_reprojection_px": 0.4,
        "images": [
            {
                "name": f"{i:02d}.jpg",
                "world_from_camera": pose[:3].tolist(),
                "camera": [focal, focal, 20.0, 15.0, 0.01, 0.0, 0.0, 0.0],
                "camera_id": 1,
                "observations": 500,
            }
            for i, pose in enumerate(poses)
        ],
        "points": [[*p.tolist(), 255, 0, 0, 0.3, 4] for p in points],
    }


def circle(count):
    angle = torch.arange(count) * (2 * math.pi / max(count, 1))
    eye = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.ones(count)], -1)
    return look_at(eye, torch.zeros(3), UP)


@pytest.fixture
def answer(monkeypatch):
    """Puts a given model in place of COLMAP's."""
    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: object())

    def give(*models):
        queue = list(models)
        monkeypatch.setattr(structure_from_motion, "_run", lambda job, advance, say: queue.pop(0))
        return queue

    return give


def test_missing_pycolmap_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"splatgraft\[sfm\]"):
        pose_photos(photo_paths(tmp_path / "photos", 3), tmp_path)


def test_two_photos_are_too_few(tmp_path, answer):
    answer()
    with pytest.raises(ValueError, match="at least 3 photos"):
        pose_photos(photo_paths(tmp_path / "photos", 2), tmp_path)


def test_photos_of_one_name_are_refused(tmp_path, answer):
    answer()
    paths = photo_paths(tmp_path / "a", 3).paths + photo_paths(tmp_path / "b", 1).paths
    with pytest.raises(ValueError, match="one photo per name"):
        pose_photos(PhotoFiles(paths), tmp_path)


def test_an_unreadable_photo_is_named(tmp_path, answer):
    answer()
    paths = photo_paths(tmp_path / "photos", 3)
    paths.paths[1].write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"01\.png"):
        pose_photos(paths, tmp_path)


def test_under_half_registered_says_what_to_do(tmp_path, answer):
    answer(model_of(circle(2)), model_of(circle(3)))
    with pytest.raises(ValueError, match=r"half of 8 photos to register, found 3; take more photos"):
        pose_photos(photo_paths(tmp_path / "photos", 8), tmp_path)


def test_the_larger_of_both_efforts_is_taken_and_reported(tmp_path, answer):
    answer(model_of(circle(4)), model_of(circle(7)))
    posed, report = pose_photos(photo_paths(tmp_path / "photos", 8), tmp_path)
    assert (report.registered, report.photos, report.missing) == (7, 8, (Unposed("07", 900, 12),))
    assert "7 of 8 photos registered" in str(report)
    assert len(posed) == 7
    assert posed.image(0).shape == (30, 40, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["images", "photos"]


def test_a_full_quick_model_needs_no_second_effort(tmp_path, answer):
    left = answer(model_of(circle(5)), model_of(circle(5)))
    pose_photos(photo_paths(tmp_path / "photos", 5), tmp_path)
    assert len(left) == 1


def test_masks_are_carried_along_undistorted_like_their_photos(tmp_path, answer):
    answer(model_of(circle(3)))
    photos = photo_paths(tmp_path / "photos", 3)
    mask = torch.zeros(30, 40, 3)
    mask[:, :20] = 1
    write_image(tmp_path / "mask.png", mask)
    posed, _ = pose_photos(replace(photos, masks=(None, tmp_path / "mask.png", None)), tmp_path)
    assert [path and path.relative_to(tmp_path).as_posix() for path in posed.mask_paths] == [None, "masks/01.png", None]
    carried = posed.mask(1)
    assert carried.shape == posed.image(1).shape[:2]
    # the middle column stays where it is, since the principal point is in the middle
    assert carried[:, :19].min() == 1
    assert carried[:, 21:].max() == 0


def test_a_mask_of_another_shape_is_refused(tmp_path, answer):
    answer()
    photos = photo_paths(tmp_path / "photos", 3)
    write_image(tmp_path / "mask.png", torch.zeros(40, 40, 3))
    with pytest.raises(ValueError, match=r"mask\.png: expected 40x30 px.*found 40x40"):
        pose_photos(replace(photos, masks=(None, tmp_path / "mask.png", None)), tmp_path)


def test_before_a_second_attempt_it_is_said_why_and_for_how_long(tmp_path, answer):
    said = []
    first = model_of(circle(7)) | {"mean_reprojection_px": 2.0, "seconds": {"features": 20.0, "mapping": 10.0}}
    answer(first, model_of(circle(8)))
    pose_photos(photo_paths(tmp_path / "photos", 8), tmp_path, say=said.append)
    assert "took 30 s (features 20, mapping 10)" in said[0]
    for expected in ("mean reprojection error", "once more with more features", "about 10 min", "effort = quick"):
        assert expected in said[1]


def test_photos_without_a_pose_are_named_with_the_usual_reason(tmp_path, answer):
    answer(model_of(circle(7)), model_of(circle(7)))
    _, report = pose_photos(photo_paths(tmp_path / "photos", 8), tmp_path)
    assert "without a pose: 07 (900 features, at most 12 matches: of another place" in str(report)


def test_a_dying_process_is_reported_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "colmap_process").mkdir()
    program = tmp_path / "colmap_process" / "__main__.py"
    program.write_text("import sys; print('nothing to match', file=sys.stderr); sys.exit(3)")
    monkeypatch.setattr(structure_from_motion, "__file__", str(tmp_path / "structure_from_motion.py"))
    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: object())
    with pytest.raises(ValueError, match="exit code 3: nothing to match"):
        pose_photos(photo_paths(tmp_path / "photos", 3), tmp_path)


def corner_photo(camera):
    """Three textured planes that meet, seen by a pinhole: rays meet the nearest plane, textures are looked up."""
    width, height = camera.width, camera.height
    v, u = np.mgrid[0:height, 0:width] + 0.5
    k, pose = camera.intrinsics[0].numpy(), camera.world_from_camera[0].numpy()
    rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1) @ pose[:3, :3].T
    generator = np.random.default_rng(0)
    color, nearest = np.zeros((height, width, 3), np.float32), np.full((height, width), np.inf)
    for axis in range(3):
        texture = sum(
            cv2.resize(generator.random((8 * 2**i, 8 * 2**i, 3)).astype(np.float32), (1024, 1024)) / 4 for i in range(4)
        )
        distance = (-1 - pose[axis, 3]) / rays[..., axis]
        hit = (distance > 0) & (distance < nearest)
        spot = pose[:3, 3] + distance[..., None] * rays
        a, b = np.delete(spot, axis, -1).transpose(2, 0, 1)
        looked_up = cv2.remap(
            texture,
            ((a + 1) * 200).astype(np.float32),
            ((b + 1) * 200).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        color[hit], nearest[hit] = looked_up[hit], distance[hit]
    return torch.from_numpy(color).clamp(0, 1)


def corner_cameras(count):
    """Cameras on an arc before the corner."""
    angle = torch.linspace(0.35, 1.2, count)
    eye = torch.stack([3 * angle.cos(), 3 * angle.sin(), 1 + 0.3 * (2 * angle).sin()], -1)
    return pinhole(look_at(eye, torch.tensor([-0.5, -0.5, -0.6]), UP), 400.0, width=400, height=300)


def truth_from_found(found, truth):
    """Rotation, and by how much camera centres differ after the best similarity transform (Umeyama 1991)."""
    x, y = found.centers.double(), truth.centers.double()
    x, y = x - x.mean(0), y - y.mean(0)
    u, _, vt = torch.linalg.svd(y.T @ x)
    rotation = u @ torch.diag(torch.tensor([1, 1, torch.det(u @ vt)]).double()) @ vt
    scale = (y * (x @ rotation.T)).sum() / x.square().sum()
    return scale.sign() * rotation, (scale * x @ rotation.T - y).norm(dim=1)


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is an optional extra")
def test_true_poses_come_back_up_to_a_similarity(tmp_path):
    truth = corner_cameras(8)
    (tmp_path / "photos").mkdir()
    paths = [tmp_path / "photos" / f"{name}.png" for name in truth.names]
    for camera, path in zip(truth, paths, strict=True):
        write_image(path, corner_photo(camera))
    posed, report = pose_photos(PhotoFiles(tuple(paths)), tmp_path, options=PoseOptions(effort="quick"))
    assert report.registered == 8
    # SIFT places features to about a third of a pixel
    assert report.mean_reprojection_px < 1
    rotation, distances = truth_from_found(posed.cameras, truth)
    # a third of a pixel at a focal length of 400 and a distance of 4 is 3 mm; hundreds of points share it, but focal
    # length and distance trade against each other: one percent of the path's 2 m
    assert distances.max() < 0.02
    # the floor, which fills most of the pictures, lies level
    up = rotation @ torch.tensor([0.0, 0, 1]).double()
    assert float(up[2]) > math.cos(math.radians(5))


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is an optional extra")
def test_photos_cut_out_of_larger_ones_have_their_optical_axis_where_it_was(tmp_path):
    truth, said = corner_cameras(10), []
    (tmp_path / "photos").mkdir()
    paths = [tmp_path / "photos" / f"{name}.png" for name in truth.names]
    for i, (camera, path) in enumerate(zip(truth, paths, strict=True)):
        picture = corner_photo(camera)
        # around 140, 105 instead of 200, 150
        write_image(path, picture[:210, :280] if i in {3, 6} else picture)
    posed, report = pose_photos(
        PhotoFiles(tuple(paths)), tmp_path, options=PoseOptions(effort="quick"), say=said.append
    )
    assert report.registered == 10
    # as for whole photos
    assert truth_from_found(posed.cameras, truth)[1].max() < 0.02
    for i in (3, 6):
        # an optical axis off by d pixels is made up for by a turn of d / 400: a tenth of the 60 px that it is off, and
        # as much of the turn against the next whole photo
        assert posed.cameras.intrinsics[i, :2, 2].tolist() == pytest.approx([200, 150], abs=6)
        found, true = (c.world_from_camera[[i, i + 1], :3, :3].double() for c in (posed.cameras, truth))
        turn = found[0].T @ found[1] @ (true[0].T @ true[1]).T
        assert float(turn.trace()) > 1 + 2 * math.cos(6 / 400)
    assert any("the lens was solved apart" in sentence for sentence in said)
