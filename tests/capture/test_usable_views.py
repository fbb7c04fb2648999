"""Photos that do not belong are found and others are not; captures with too few views or one viewpoint are refused."""

import cv2
import numpy as np
import pytest
import torch
from made_captures import SIZE, ring, texture, write_photos
from PIL import Image

from splatgraft.capture import require_coverage, usable_photos
from splatgraft.capture.usable_views import find_odd_photos, median_parallax_deg
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.posed_images import PosedImages

NO_POINTS = torch.zeros(0, 3)


def motion(pixels: np.ndarray, length: int, angle_deg: float) -> np.ndarray:
    kernel = np.zeros((length, length), np.float32)
    kernel[length // 2] = 1
    turn = cv2.getRotationMatrix2D(((length - 1) / 2, (length - 1) / 2), angle_deg, 1)
    kernel = cv2.warpAffine(kernel, turn, (length, length))
    return cv2.filter2D(pixels, -1, kernel / kernel.sum())


def test_different_sharp_photos_all_stay_also_one_of_less_contrast(tmp_path):
    photos = write_photos(tmp_path / "photos", 12)
    Image.fromarray((100 + texture(4) // 4).astype(np.uint8)).save(photos[4])
    assert find_odd_photos(photos) == ()
    for i, photo in enumerate(photos):  # if all photos are soft, none is odd
        Image.fromarray(cv2.GaussianBlur(texture(i), (0, 0), 2)).save(photo)
    assert find_odd_photos(photos) == ()


@pytest.mark.parametrize(
    "blur",
    [
        lambda p: cv2.GaussianBlur(p, (0, 0), 2),
        lambda p: cv2.GaussianBlur(p, (0, 0), 8),
        lambda p: motion(p, 9, 0),
        lambda p: motion(p, 15, 40),
    ],
)
def test_one_blurred_photo_is_named(tmp_path, blur):
    photos = write_photos(tmp_path / "photos", 12)
    Image.fromarray(blur(texture(4))).save(photos[4])
    (odd,) = find_odd_photos(photos)
    assert odd.name == str(photos[4])
    assert "blurred" in odd.reason


def test_copies_are_found_also_saved_again_smaller_and_black(tmp_path):
    photos = write_photos(tmp_path / "photos", 10)
    photographed = (640, 480)  # thumbnails average over the noise of compression
    Image.fromarray(texture(3, photographed)).save(photos[3])
    again = [photos[0].with_name("again.jpg"), photos[0].with_name("small.png")]
    Image.fromarray(texture(3, photographed)).save(again[0], quality=80)
    Image.fromarray(texture(3, photographed)).resize((320, 240), Image.Resampling.LANCZOS).save(again[1])
    for photo in photos[:2]:
        Image.new("RGB", SIZE).save(photo)  # no detail, so the measure must not divide by it
    odd = find_odd_photos([*photos, *again])
    assert [one.name for one in odd] == [str(path) for path in (photos[1], *again)]
    assert all("0003.png, found a copy of it" in one.reason for one in odd[1:])


def test_unreadable_and_tiny_photos_are_named_also_where_copies_and_blur_are_wanted(tmp_path):
    photos = write_photos(tmp_path / "photos", 12, ".jpg")
    photos[1].write_bytes(photos[1].read_bytes()[:2000])
    photos[2].write_bytes(b"")
    Image.new("RGB", (1, 1)).save(photos[3])
    odd = {one.name: one.reason for one in find_odd_photos(photos)}
    assert list(odd) == list(map(str, photos[1:4]))
    assert "truncated" in odd[str(photos[1])]
    assert "at least 16 px, found 1x1" in odd[str(photos[3])]
    Image.fromarray(cv2.GaussianBlur(texture(4), (0, 0), 3)).save(photos[4])
    Image.fromarray(texture(0)).save(photos[5])
    kept, left_out = usable_photos(photos, "here", keep_odd=True)
    assert {one.name: one.reason for one in left_out} == odd
    assert kept == [photos[0], *photos[4:]]


def capture(cameras: Cameras, points: torch.Tensor = NO_POINTS) -> PosedImages:
    return PosedImages(image_paths=(), cameras=cameras, points=points, point_colors=torch.zeros_like(points))


def cloud(count: int = 80) -> torch.Tensor:
    return 0.3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(1))


def side_by_side(count: int, step: float, distance: float) -> Cameras:
    """Return parallel cameras on a line, `distance` before the origin."""
    x = (torch.arange(count) - (count - 1) / 2) * step
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, 0, 3], poses[:, 2, 3] = x, -distance
    return pinhole(poses, 150.0, width=160, height=120)


def outwards(count: int) -> Cameras:
    """Return cameras at one place that look in all directions."""
    angle = torch.arange(count) * (2 * torch.pi / count)
    goal = torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], -1)
    poses = torch.cat([look_at(torch.zeros(1, 3), g, torch.tensor([0.0, 0, 1])) for g in goal])
    return pinhole(poses, 150.0, width=160, height=120)


@pytest.mark.parametrize("points", [NO_POINTS, cloud()])
def test_a_ring_is_enough_and_three_views_are_too_few(points):
    require_coverage(capture(ring(8), points), "here")
    # cameras opposite each other at 2 around and 1 above the points: 2 atan(2 / 1) = 127 degrees
    assert median_parallax_deg(ring(8), points) == pytest.approx(127, abs=20)
    with pytest.raises(ValueError, match=r"^here: expected at least 8 posed views with a parallax of 3 .*found 3$"):
        require_coverage(capture(ring(3), points), "here")


@pytest.mark.parametrize("points", [NO_POINTS, cloud() + torch.tensor([3.0, 0, 0])])
def test_cameras_at_one_point_are_refused(points):
    with pytest.raises(ValueError, match=r"found 20 views with 0 degrees: the cameras stand in one place"):
        require_coverage(capture(outwards(20), points), "here")


def test_parallax_is_the_angle_between_the_outermost_cameras():
    # 10 cameras, 9 steps of 0.01, 10 away: 0.5 degrees
    narrow = median_parallax_deg(side_by_side(10, 0.01, 10.0), cloud())
    assert narrow == pytest.approx(0.516, rel=0.05)
    with pytest.raises(ValueError, match=r"found 10 views with 0\.5"):
        require_coverage(capture(side_by_side(10, 0.01, 10.0), cloud()), "here")
    require_coverage(capture(side_by_side(10, 0.1, 10.0), cloud()), "here")


def test_a_walk_that_looks_outwards_without_points_is_not_refused():
    cameras = outwards(12)
    cameras.world_from_camera[:, :3, 3] = 0.3 * torch.randn(12, 3, generator=torch.Generator().manual_seed(2))
    require_coverage(capture(cameras), "here")
