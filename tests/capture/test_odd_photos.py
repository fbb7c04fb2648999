"""Odd photos: copies, blurred, unreadable and tiny ones are found; others are not."""

import cv2
import numpy as np
import pytest
from made_captures import SIZE, texture, write_photos
from PIL import Image

from splatgraft.capture import usable_photos
from splatgraft.capture.odd_photos import find_odd_photos


def motion(pixels: np.ndarray, length: int, angle_deg: float) -> np.ndarray:
    kernel = np.zeros((length, length), np.float32)
    kernel[length // 2] = 1
    turn = cv2.getRotationMatrix2D(((length - 1) / 2, (length - 1) / 2), angle_deg, 1)
    kernel = cv2.warpAffine(kernel, turn, (length, length))
    return cv2.filter2D(pixels, -1, kernel / kernel.sum())


def test_different_sharp_photos_all_stay(tmp_path):
    assert find_odd_photos(write_photos(tmp_path / "photos", 12)) == ()


@pytest.mark.parametrize(
    "blur",
    [
        lambda p: cv2.GaussianBlur(p, (0, 0), 2),
        lambda p: cv2.GaussianBlur(p, (0, 0), 8),
        lambda p: motion(p, 9, 0),
        lambda p: motion(p, 9, 90),
        lambda p: motion(p, 15, 40),
    ],
)
def test_one_blurred_photo_is_named(tmp_path, blur):
    photos = write_photos(tmp_path / "photos", 12)
    Image.fromarray(blur(texture(4))).save(photos[4])
    odd = find_odd_photos(photos)
    assert [one.name for one in odd] == [str(photos[4])]
    assert "blurred" in odd[0].reason


def test_a_photo_of_less_contrast_is_not_blurred(tmp_path):
    photos = write_photos(tmp_path / "photos", 12)
    Image.fromarray((100 + texture(4) // 4).astype(np.uint8)).save(photos[4])
    assert find_odd_photos(photos) == ()


def test_where_all_are_soft_none_is_odd(tmp_path):
    photos = write_photos(tmp_path / "photos", 12)
    for i, photo in enumerate(photos):
        Image.fromarray(cv2.GaussianBlur(texture(i), (0, 0), 2)).save(photo)
    assert find_odd_photos(photos) == ()


def test_copies_are_found_also_saved_again_and_smaller(tmp_path):
    photos = write_photos(tmp_path / "photos", 10)
    photographed = (640, 480)  # thumbnails average over the noise of compression
    Image.fromarray(texture(3, photographed)).save(photos[3])
    again = [photos[0].with_name("again.jpg"), photos[0].with_name("small.png")]
    Image.fromarray(texture(3, photographed)).save(again[0], quality=80)
    Image.fromarray(texture(3, photographed)).resize((320, 240), Image.Resampling.LANCZOS).save(again[1])
    odd = find_odd_photos([*photos, *again])
    assert {one.name for one in odd} == set(map(str, again))
    assert all("0003.png, found a copy of it" in one.reason for one in odd)


def test_unreadable_and_tiny_photos_are_named(tmp_path):
    photos = write_photos(tmp_path / "photos", 10, ".jpg")
    photos[1].write_bytes(photos[1].read_bytes()[:2000])
    photos[2].write_bytes(b"")
    Image.new("RGB", (1, 1)).save(photos[3])
    odd = {one.name: one.reason for one in find_odd_photos(photos)}
    assert list(odd) == list(map(str, photos[1:4]))
    assert "truncated" in odd[str(photos[1])]
    assert "at least 16 px, found 1x1" in odd[str(photos[3])]


def test_one_photo_many_times_is_refused_with_what_is_needed(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    photos = [folder / f"{i:02d}.png" for i in range(50)]
    for photo in photos:
        Image.fromarray(texture(0)).save(photo)
    with pytest.raises(ValueError, match=r"^here: expected at least 8 different photos .*found 1 of 50; .*copy of it"):
        usable_photos(photos, "here")


def test_copies_and_blur_stay_where_that_is_wanted_and_unreadable_ones_never(tmp_path):
    photos = write_photos(tmp_path / "photos", 10)
    Image.fromarray(cv2.GaussianBlur(texture(4), (0, 0), 3)).save(photos[4])
    Image.fromarray(texture(0)).save(photos[5])
    photos[6].write_bytes(b"no image")
    kept, odd = usable_photos(photos, "here", keep_odd=True)
    assert [one.name for one in odd] == [str(photos[6])]
    assert kept == [*photos[:6], *photos[7:]]


def test_black_photos_are_copies_and_no_division_fails(tmp_path):
    photos = write_photos(tmp_path / "photos", 10)
    for photo in photos[:2]:
        Image.new("RGB", SIZE).save(photo)
    assert [one.name for one in find_odd_photos(photos)] == [str(photos[1])]
