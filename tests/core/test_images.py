"""Image files in all modes of cameras and tools, the sRGB transfer function, resampling."""

import resource
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from splatgraft.core import images

PIXELS = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)


def test_transfer_is_the_standards_and_inverts():
    values = torch.linspace(-1, 2, 4001, dtype=torch.float64)
    # the two pieces of the standard meet to within 4e-8 at its rounded thresholds
    assert (images.srgb_from_linear(images.linear_from_srgb(values)) - values).abs().max() < 1e-6
    middle = images.linear_from_srgb(torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64))
    assert torch.allclose(middle, torch.tensor([0, 0.21404114, 1], dtype=torch.float64), atol=1e-8)  # IEC 61966-2-1


def test_transfer_has_finite_slopes_everywhere():
    values = torch.tensor([-0.5, -1e-9, 0.0, 1e-12, 0.003, 1.0, 3.0], requires_grad=True)
    images.srgb_from_linear(values).sum().backward()
    assert torch.isfinite(values.grad).all()


def test_write_and_read(tmp_path):
    image = torch.from_numpy(PIXELS).float() / 255
    for suffix in sorted(images.WRITTEN_SUFFIXES):
        path = tmp_path / f"a{suffix}"
        images.write_image(path, image)
        images.write_image(path, image)
        found = images.read_rgb(path)
        assert found.shape == image.shape
        assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
        if suffix not in (".jpg", ".jpeg", ".webp"):
            assert torch.equal(found, image)
        images.write_image(path, image[..., 0])
        assert images.read_mask(path).shape == (12, 20)
        path.unlink()


def test_values_outside_are_clamped_and_an_unknown_suffix_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"a\.xyz: expected an image name"):
        images.write_image(tmp_path / "a.xyz", torch.zeros(2, 2))
    assert list(tmp_path.iterdir()) == []
    images.write_image(tmp_path / "a.png", torch.tensor([[-1.0, 0.5, 7.0]]))
    assert images.read_mask(tmp_path / "a.png").tolist() == [[0, pytest.approx(128 / 255), 1]]


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_exif_turns_the_picture_but_not_the_stored_grid(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(PIXELS).save(tmp_path / "a.png", exif=exif)
    stored = torch.from_numpy(PIXELS).float() / 255
    # the tag names the sides of row 0 and column 0: EXIF 2.3, table of tag 274
    seen = {
        1: stored,
        2: stored.flip(1),
        3: stored.flip(0, 1),
        6: stored.flip(0).transpose(0, 1),
        8: stored.flip(1).transpose(0, 1),
    }[orientation]
    assert torch.equal(images.read_rgb(tmp_path / "a.png"), seen)
    assert torch.equal(images.read_stored_rgb(tmp_path / "a.png"), stored)
    assert images.stored_size(tmp_path / "a.png") == (20, 12)


def test_sixteen_bits_are_scaled_by_their_range(tmp_path):
    ramp = np.linspace(0, 65535, 240).reshape(12, 20).astype(np.uint16)
    Image.fromarray(ramp // 2).save(tmp_path / "a.png")  # never reaches white: the range counts, not the maximum
    expected = torch.from_numpy((ramp // 2).astype(np.float32) / 65535)
    assert torch.equal(images.read_mask(tmp_path / "a.png"), expected)
    assert torch.equal(images.read_rgb(tmp_path / "a.png"), expected[..., None].expand(-1, -1, 3))


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "RGBA", "RGB", "CMYK", "I;16", "F"])
def test_every_mode_reads(tmp_path, mode):
    grey = Image.fromarray(np.repeat(PIXELS[..., :1], 3, 2))
    if mode == "I;16":
        image = Image.fromarray((PIXELS[..., 0].astype(np.uint16)) * 257)
    elif mode == "F":
        image = Image.fromarray(PIXELS[..., 0].astype(np.float32) / 255)
    else:
        image = grey.convert(mode)
    path = tmp_path / ("a.tif" if mode in ("CMYK", "F") else "a.png")
    image.save(path)
    rgb, mask = images.read_rgb(path), images.read_mask(path)
    assert rgb.shape == (12, 20, 3)
    assert mask.shape == (12, 20)
    if mode not in ("1", "P"):  # these keep fewer values
        expected = torch.from_numpy(PIXELS[..., 0]).float() / 255
        assert (rgb - expected[..., None]).abs().max() < 1.5 / 255  # rounding of one byte by CMYK or luma
        assert (mask - expected).abs().max() < 1.5 / 255


def test_transparent_palette(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "opaque.png")
    assert not images.has_transparency(tmp_path / "opaque.png")
    assert images.read_alpha(tmp_path / "opaque.png").min() == 1
    image = Image.fromarray(np.array([[0, 1], [1, 0]], np.uint8)).convert("P")
    image.putpalette([255, 0, 0, 0, 255, 0])
    image.save(tmp_path / "a.png", transparency=0)
    assert images.has_transparency(tmp_path / "a.png")
    assert images.read_alpha(tmp_path / "a.png").tolist() == [[0, 1], [1, 0]]
    assert images.read_mask(tmp_path / "a.png").tolist() == [[0, 1], [1, 0]]
    assert images.read_rgb(tmp_path / "a.png")[0].tolist() == [[0, 0, 0], [0, 1, 0]]


def png_that_claims(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("width", "height"), [(13000, 13000), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_sizes_that_a_header_claims_take_no_memory(tmp_path, width, height):
    (tmp_path / "a.png").write_bytes(png_that_claims(width, height))
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tracemalloc.start()
    for read in (images.read_rgb, images.read_stored_rgb, images.read_mask, images.read_alpha):
        with pytest.raises(ValueError, match=r"a\.png: expected a readable image, found"):
            read(tmp_path / "a.png")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5_000_000
    assert (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - resident < 100_000
    )  # kB; 13000 x 13000 x 3 would be 507 MB


@pytest.mark.parametrize("data", [b"GIF89a", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_refused(tmp_path, data):
    (tmp_path / "a.png").write_bytes(data)
    for name, found in (("a.png", "readable image"), ("b.png", "found none")):
        for read in (images.read_rgb, images.read_mask, images.stored_size, images.has_transparency):
            with pytest.raises(ValueError, match=f"{name}: expected .*{found}") as caught:
                read(tmp_path / name)
            assert "\n" not in str(caught.value)


def test_list_images_is_sorted_and_leaves_out_the_rest(tmp_path):
    for name in ("b.JPG", "a.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in images.list_images(tmp_path)] == ["a.png", "b.JPG"]


def test_resize_keeps_constants_and_shapes_and_halving_is_the_mean_of_four():
    for size in ((20, 12), (10, 6), (40, 24), (7, 5)):
        for channels in ((), (1,), (3,)):
            resized = images.resize(torch.full((12, 20, *channels), 0.3), *size)
            assert (resized - 0.3).abs().max() < 1e-6  # weights sum to 1 in float32
            assert resized.shape == (size[1], size[0], *channels)
    image = torch.rand(12, 20, 3)
    expected = image.reshape(6, 2, 10, 2, 3).mean((1, 3))
    assert (images.resize(image, 10, 6) - expected).abs().max() < 1e-6  # float32 sums of four
