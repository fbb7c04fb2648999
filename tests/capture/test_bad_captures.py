"""`capture` on broken and unusual captures: goes on and says so, or refuses in one line and keeps what was there."""

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from made_captures import SIZE, disc, texture, write_photos, write_posed
from PIL import Image

from splatgraft.capture.odd_photos import drawn_pictures
from splatgraft.cli import main
from splatgraft.core import images
from splatgraft.core.exposure import Exposure
from splatgraft.formats import read_capture
from splatgraft.formats.captures.exif import exif_of, read_exposure


def capture(folder: Path, out: Path, *more: str) -> int:
    return main(["capture", str(folder), "--out", str(out), *more])


def change(folder: Path, **keys: object) -> None:
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | keys))


def change_frame(folder: Path, index: int, **keys: object) -> None:
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    meta["frames"][index] |= keys
    path.write_text(json.dumps(meta))


def test_what_is_not_usable_is_named_counted_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = write_posed(tmp_path / "c", 14)
    photos[1].unlink()
    photos[2].write_bytes(photos[2].read_bytes()[:5000])
    Image.new("RGB", (1, 1)).save(photos[3])
    change_frame(tmp_path / "c", 4, transform_matrix=[[float("nan")] * 4] * 4)
    Image.fromarray(texture(0)).save(photos[5])
    assert capture(tmp_path / "c", tmp_path / "out") == 0
    assert read_capture(tmp_path / "out").cameras.names == tuple(p.name for p in (photos[0], *photos[6:]))
    said = capsys.readouterr().err
    head = next(line for line in said.splitlines() if "warning" in line)
    assert "goes on with 9 of 14 images" in head
    assert all(f"{i:04d}.png" in head for i in range(1, 6))
    for reason in ("found none in", "truncated", "found 1x1", "finite numbers", "a copy of it"):
        assert f"{reason}" in said


def test_fewer_than_half_are_refused_and_the_earlier_result_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = write_posed(tmp_path / "c", 12)
    assert capture(tmp_path / "c", tmp_path / "out") == 0
    earlier = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    capsys.readouterr()
    for photo in photos[:7]:
        photo.unlink()
    assert capture(tmp_path / "c", tmp_path / "out") == 2
    lines = capsys.readouterr().err.splitlines()
    assert "transforms.json: expected at least 50% of 12 images to be usable, found 5" in lines[-1]
    # found only while the step works
    for photo in photos:
        Image.fromarray(texture(0)).save(photo)
    assert capture(tmp_path / "c", tmp_path / "out") == 2
    assert "expected at least 8 posed views with a parallax of 3 degrees" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == earlier
    assert not (tmp_path / ".out.new").exists()


@pytest.mark.parametrize(
    ("keys", "expected"),
    [({"fl_x": 0, "fl_y": 0}, "focal length above 0"), ({"fl_x": float("nan")}, "finite number for 'fl_x', found nan")],
)
def test_intrinsics_of_zero_or_nan_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: dict[str, object], expected: str
) -> None:
    write_posed(tmp_path / "c")
    change(tmp_path / "c", **keys)
    assert capture(tmp_path / "c", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "c/transforms.json" in line
    assert expected in line


def test_images_without_a_pose_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_posed(tmp_path / "c", 30)
    path = tmp_path / "c" / "transforms.json"
    frames = json.loads(path.read_text())["frames"]
    change(tmp_path / "c", frames=frames[::3])
    assert capture(tmp_path / "c", tmp_path / "out") == 0
    assert "only 10 of the 30 images in" in capsys.readouterr().err
    change(tmp_path / "c", frames=frames[:3])
    assert capture(tmp_path / "c", tmp_path / "out") == 2
    assert "are usual), found 3 (see " in capsys.readouterr().err.splitlines()[-1]


def test_masks_of_one_colour_or_another_size_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = write_posed(tmp_path / "c", 10, masks=True)
    masks = [tmp_path / "c" / "masks" / photo.name for photo in photos]
    Image.fromarray(np.zeros_like(disc())).save(masks[1])
    Image.fromarray(np.full_like(disc(), 255)).save(masks[2])
    Image.fromarray(disc()).resize((50, 50)).save(masks[3])
    Image.fromarray(disc()).resize((SIZE[0] // 2, SIZE[1] // 2)).save(masks[4])  # the same shape
    assert capture(tmp_path / "c", tmp_path / "out") == 0
    found = read_capture(tmp_path / "out")
    assert [path is None for path in found.mask_paths] == [False, True, True, True, *[False] * 6]
    said = capsys.readouterr().err
    assert "goes on with 10 of 10 images, without the mask of images/0003.png, the mask of 0001.png" in said
    assert "0001.png: expected white where the object is, found black all over" in said
    assert "0002.png: expected white where the object is, found white all over" in said
    assert "0003.png: expected 160x120 px" in said


def test_all_masks_black_leaves_a_capture_without_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = write_posed(tmp_path / "c", 10, masks=True)
    for photo in photos:
        Image.fromarray(np.zeros_like(disc())).save(tmp_path / "c" / "masks" / photo.name)
    assert capture(tmp_path / "c", tmp_path / "out") == 0
    assert read_capture(tmp_path / "out").mask_paths == ()
    assert "and 2 more" in capsys.readouterr().err


def test_large_photos_are_reduced_once_with_masks_and_exposure(tmp_path: Path) -> None:
    photos = write_posed(tmp_path / "c", 10, masks=True)
    large = photos[3].with_suffix(".jpg")
    photos[3].unlink()
    exif = exif_of(Exposure(1 / 60, 8.0, 100.0))
    Image.fromarray(texture(3)).resize((1280, 960), Image.Resampling.BICUBIC).save(large, quality=97, exif=exif)
    change_frame(tmp_path / "c", 3, file_path="images/0003.jpg")
    assert capture(tmp_path / "c", tmp_path / "out", "--max-side", "200") == 0
    found, given = read_capture(tmp_path / "out"), read_capture(tmp_path / "c")
    # the others are referred to where they are
    inside = [path.resolve().is_relative_to(tmp_path / "out") for path in found.image_paths]
    assert inside == [i == 3 for i in range(10)]
    assert images.stored_size(found.image_paths[3]) == SIZE
    assert read_exposure(found.image_paths[3]).shutter_s == pytest.approx(1 / 60)
    assert torch.equal(found.cameras.intrinsics, given.cameras.intrinsics)
    # JPEG of quality 95 rounds this noise by 3 grey levels in the mean, which add to those of the photo
    assert float((found.image(3) - given.image(3)).abs().mean()) < 6 / 255
    truth, mask = given.mask(3), found.mask(3)
    assert truth is not None
    assert mask is not None
    assert torch.equal(mask > 0.5, truth > 0.5)


def test_distorted_large_photos_are_reduced_without_distortion(tmp_path: Path) -> None:
    write_posed(tmp_path / "c", 10)
    change(tmp_path / "c", k1=-0.1)
    assert capture(tmp_path / "c", tmp_path / "out", "--max-side", "80") == 0
    found, given = read_capture(tmp_path / "out"), read_capture(tmp_path / "c").limited(80)
    assert found.distortions == ()
    torch.testing.assert_close(found.cameras.intrinsics, given.cameras.intrinsics)
    # reduced before and after the distortion is removed; JPEG
    for i in range(10):
        assert float((found.image(i) - given.image(i)).abs().mean()) < 6 / 255


def test_small_photos_are_not_shrunk_with_large_ones(tmp_path: Path) -> None:
    photos = write_posed(tmp_path / "c", 10)
    Image.fromarray(texture(3)).resize((1280, 960), Image.Resampling.BICUBIC).save(photos[3])
    for index in range(10):
        factor = 8 if index == 3 else 1
        change_frame(tmp_path / "c", index, w=160 * factor, h=120 * factor, fl_x=150 * factor, fl_y=150 * factor)
        change_frame(tmp_path / "c", index, cx=80 * factor, cy=60 * factor)
    assert capture(tmp_path / "c", tmp_path / "out", "--max-side", "320") == 0
    assert read_capture(tmp_path / "out").cameras.sizes.tolist() == [[160, 120]] * 3 + [[320, 240]] + [[160, 120]] * 6


def test_photos_without_poses_that_are_one_photo_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for photo in write_photos(tmp_path / "c", 12):
        Image.fromarray(texture(0)).save(photo)
    assert capture(tmp_path / "c", tmp_path / "out") == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"splatgraft: {tmp_path / 'c'}: expected at least 8 different photos")
    assert "found 1 of 12" in line
    assert not (tmp_path / "out").exists()


def test_screenshots_are_warned_of(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "c", 9)
    assert drawn_pictures(photos) is None
    for i, photo in enumerate(photos):
        page = np.full((SIZE[1], SIZE[0], 3), 245, np.uint8)
        page[10 * i : 10 * i + 20, 20:60] = (40, 60, 20 * i)
        Image.fromarray(page).save(photo)
    sentence = drawn_pictures(photos)
    assert sentence is not None
    assert "expected photographs, found pictures that are even over" in sentence


def test_heic_without_its_reader_says_how_to_install_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "find_spec", lambda name: None)
    (tmp_path / "c").mkdir()
    for i in range(9):
        (tmp_path / "c" / f"IMG_{i}.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    assert capture(tmp_path / "c", tmp_path / "out") == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "IMG_0.HEIC" in line
    assert "pip install 'splatgraft[heic]'" in line


@pytest.mark.skipif(find_spec("pillow_heif") is None, reason="pillow-heif is an optional extra")
def test_heic_is_read(tmp_path: Path) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    pixels = texture(1)[..., :1].repeat(3, -1)  # HEIC halves the resolution of colour alone
    Image.fromarray(pixels).save(tmp_path / "a.heic", quality=95)
    assert images.list_images(tmp_path) == [tmp_path / "a.heic"]
    # lossy, but close to what was written
    assert float((images.read_rgb(tmp_path / "a.heic") - torch.from_numpy(pixels).float() / 255).abs().mean()) < 0.03
    assert images.stored_size(tmp_path / "a.heic") == SIZE
