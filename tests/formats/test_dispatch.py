"""The choice of the format by suffix and by the files in a folder."""

import format_files
import pytest

from splatgraft import formats


@pytest.mark.parametrize("read", [formats.read_gaussians, formats.read_capture, formats.read_cameras])
@pytest.mark.parametrize("name", ["a.ply", "a.json", "none", "a" * 300 + ".ply", "a" * 300])
def test_what_is_not_there_is_named(tmp_path, read, name):
    with pytest.raises(ValueError, match=r": expected .*found") as caught:
        read(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


def test_suffixes_in_capitals(tmp_path):
    g = format_files.random_gaussians(3, 1)
    formats.write_gaussians(tmp_path / "A.PLY", g)
    assert format_files.equal(formats.read_gaussians(tmp_path / "A.PLY"), g)


def test_transforms_count_before_colmap(tmp_path):
    format_files.write_transforms(tmp_path, {})
    format_files.write_colmap(tmp_path / "sparse" / "0")
    assert formats.read_capture(tmp_path).cameras.names == ("0000.png", "0001.png")


def test_cameras_of_any_capture_without_its_images(tmp_path):
    format_files.write_colmap(tmp_path / "sparse" / "0")
    assert formats.read_cameras(tmp_path).names == ("a.png", "b.png")
