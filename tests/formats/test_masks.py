"""Masks are matched to photographs by stem, or taken from alpha channels."""

import format_files
import numpy as np
import pytest
import torch
from PIL import Image

from splatgraft import formats
from splatgraft.formats.captures.masks import describe_masks, find_photos


@pytest.mark.parametrize("names", [("0000.png", "0001.png"), ("0000.png.png", "0001.jpg"), ("0000.png", None)])
def test_masks_by_stem(tmp_path, names):
    format_files.write_transforms(tmp_path, {})
    for name in filter(None, names):
        format_files.write_photo(tmp_path / "masks" / name)
    found = formats.read_capture(tmp_path).mask_paths
    assert tuple(path.name if path else None for path in found) == names


def test_masks_in_folders(tmp_path):
    format_files.write_colmap(tmp_path / "sparse", names=("left/0.jpg", "right/0.jpg"))
    for side in ("left", "right"):
        format_files.write_photo(tmp_path / "images" / side / "0.jpg")
        format_files.write_photo(tmp_path / "masks" / side / "0.png")
    found = formats.read_capture(tmp_path).mask_paths
    assert [path.parent.name for path in found] == ["left", "right"]


@pytest.mark.parametrize("names", [("other.png",), ("0000.png", "0000.jpg"), ()])
def test_refusals(tmp_path, names):
    format_files.write_transforms(tmp_path, {})
    (tmp_path / "masks").mkdir()
    for name in names:
        format_files.write_photo(tmp_path / "masks" / name)
    with pytest.raises(ValueError, match=r"masks: expected .*found"):
        formats.read_capture(tmp_path)


def test_mask_of_another_shape_is_refused(tmp_path):
    format_files.write_transforms(tmp_path, {})
    format_files.write_photo(tmp_path / "masks" / "0000.png", 16, 24)
    with pytest.raises(ValueError, match=r"masks/0000\.png: expected 24x16 px.*found 16x24"):
        formats.read_capture(tmp_path)
    # one of two is half
    format_files.write_photo(tmp_path / "masks" / "0001.png", 48, 32)
    capture = formats.read_capture(tmp_path)
    assert capture.mask_paths == (None, tmp_path / "masks" / "0001.png")
    assert [str(one) for one in capture.left_out] == ["the mask of images/0000.png"]


def test_photographs_alpha_is_the_mask_and_black_what_it_hides(tmp_path):
    format_files.write_transforms(tmp_path, {})
    rgba = np.random.default_rng(0).integers(0, 256, (16, 24, 4), dtype=np.uint8)
    opaque = rgba.copy()
    opaque[..., 3] = 255
    Image.fromarray(rgba).save(tmp_path / "images" / "0001.png")
    Image.fromarray(opaque).save(tmp_path / "images" / "0000.png")
    capture = formats.read_capture(tmp_path)
    assert capture.mask(0).min() == 1
    assert torch.equal(capture.mask(1), torch.from_numpy(rgba[..., 3]).float() / 255)
    values = torch.from_numpy(rgba).float() / 255
    assert torch.equal(capture.image(1), values[..., :3] * values[..., 3:])
    # written and read again, the masks are still the alpha channels
    (tmp_path / "copy").mkdir()
    formats.write_capture(tmp_path / "copy", capture)
    assert torch.equal(formats.read_capture(tmp_path / "copy").mask(0), capture.mask(0))


def test_no_masks_and_alpha_that_is_full_everywhere_is_none(tmp_path):
    format_files.write_transforms(tmp_path, {})
    assert formats.read_capture(tmp_path).mask(0) is None
    for i in range(2):
        Image.fromarray(np.full((16, 24, 4), 255, np.uint8)).save(tmp_path / "images" / f"{i:04d}.png")
    assert formats.read_capture(tmp_path).mask_paths == ()


@pytest.mark.parametrize("place", ["masks/0001.png", "mask/0001.png", "images/0001_mask.png", "images/0001.mask.png"])
def test_masks_by_the_conventions_of_the_field(tmp_path, place):
    """Masks as Metashape and RealityCapture write them are found, for photos with poses and without."""
    format_files.write_transforms(tmp_path, {})
    format_files.write_photo(tmp_path / place)
    expected = (None, tmp_path / place)
    assert formats.read_capture(tmp_path).mask_paths == expected
    for folder in (tmp_path, tmp_path / "images"):
        found = find_photos(folder)
        assert [path.name for path in found.paths] == ["0000.png", "0001.png"]
        assert found.masks == expected
        said = describe_masks(found.paths, found.masks)
        assert said.startswith("1 of 2 photos have masks, in ")
        assert ("NAME_mask" if "images/" in place else place.split("/")[0] + "/") in said


def test_alpha_channels_of_masks_and_of_photos_without_poses_are_masks(tmp_path):
    rgba = np.zeros((16, 24, 4), np.uint8)
    rgba[:8, :, 3] = 255
    format_files.write_transforms(tmp_path, {})
    for folder in ("masks", "photos"):
        (tmp_path / folder).mkdir()
        for i in range(2):
            Image.fromarray(rgba).save(tmp_path / folder / f"{i:04d}.png")
    mask = formats.read_capture(tmp_path).mask(0)
    assert mask[:8].min() == 1
    assert mask[8:].max() == 0
    found = find_photos(tmp_path / "photos")
    assert describe_masks(found.paths, found.paths) == "2 of 2 photos have masks, in alpha channels"
    (tmp_path / "masks").rename(tmp_path / "others")
    assert find_photos(tmp_path / "photos").masks == found.paths


def test_a_folder_without_photos_and_a_photo_that_cannot_be_read(tmp_path):
    (tmp_path / "sparse").mkdir()
    with pytest.raises(ValueError, match=r"expected photos, in the folder itself or in images/, found sparse"):
        find_photos(tmp_path)
    for name in ("0.png", "1.png"):
        format_files.write_photo(tmp_path / name)
    (tmp_path / "2.jpg").write_bytes(b"")
    found = find_photos(tmp_path)
    assert [path.name for path in found.paths] == ["0.png", "1.png", "2.jpg"]
    assert found.masks == ()
