""".splat, .spz and SuperSplat's compressed .ply: within their own steps of the truth, and equal to gsply's decoding.

golden/ was written and decoded by gsply 0.4.6 (MIT), from `format_files.random_gaussians(7, 2, seed=5)`.
"""

import struct
import zlib
from pathlib import Path

import format_files
import numpy as np
import pytest
import torch

from splatgraft import formats
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.similarity import Similarity

GOLDEN = Path(__file__).parent / "golden"
HALF_TURN = Similarity(scale=1.0, rotation=torch.diag(torch.tensor([1.0, -1, -1])), translation=torch.zeros(3))


def decoded_by_gsply(name: str) -> Gaussians:
    with np.load(GOLDEN / f"{name}.npz") as arrays:
        return Gaussians(**{key: torch.from_numpy(arrays[key]) for key in arrays.files})


def assert_close(a: Gaussians, b: Gaussians, *, atol: float) -> None:
    torch.testing.assert_close(a.means, b.means, atol=atol, rtol=0)
    torch.testing.assert_close(a.log_scales, b.log_scales, atol=atol, rtol=0)
    # an ellipsoid is the same with its own axes reversed; entries sum 3 products of at most 3, quadratic in quaternions
    ellipsoids = [g.rotations @ torch.diag(torch.tensor([1.0, 2, 3])) @ g.rotations.transpose(1, 2) for g in (a, b)]
    torch.testing.assert_close(ellipsoids[0], ellipsoids[1], atol=12 * atol, rtol=0)
    torch.testing.assert_close(a.opacities, b.opacities, atol=atol, rtol=0)
    torch.testing.assert_close(a.sh, b.sh, atol=atol, rtol=0)


def test_compressed_ply_as_gsply_decodes_it():
    g = formats.read_gaussians(GOLDEN / "supersplat.compressed.ply")
    assert_close(g, decoded_by_gsply("supersplat.compressed.ply"), atol=2e-6)  # float32 sums of values up to 10


def test_spz_as_gsply_decodes_it_turned_to_our_axes():
    ours = formats.read_gaussians(GOLDEN / "v3.spz")
    assert_close(ours, HALF_TURN.gaussians(decoded_by_gsply("v3.spz")), atol=2e-6)  # as above


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_round_trip_is_within_its_steps(tmp_path, degree):
    g = format_files.random_gaussians(300, degree)
    formats.write_gaussians(tmp_path / "a.spz", g)
    back = formats.read_gaussians(tmp_path / "a.spz")
    extent = float(g.means.abs().max())
    # half a step: 24 signed bits of at most twice the extent; 1/16 of log scale; 1/255; 1/(255 * 0.15); 1/128
    assert (back.means - g.means).abs().max() <= extent * 2 / 2**23
    assert (back.log_scales - g.log_scales).abs().max() <= 0.5 / 16 + 1e-6
    assert (back.opacities - g.opacities).abs().max() <= 0.5 / 255 + 1e-6
    assert (back.sh[:, :1] - g.sh[:, :1]).abs().max() <= 0.5 / 255 / 0.15 + 1e-6
    inside = g.sh[:, 1:].abs() < 127 / 128
    assert ((back.sh[:, 1:] - g.sh[:, 1:]).abs()[inside] <= 0.5 / 128 + 1e-6).all()
    # three components each off by half of sqrt(1/2)/511, the fourth by up to their sum: angle below 2 * |difference|
    dot = (torch.nn.functional.normalize(g.quaternions, dim=1) * back.quaternions).sum(1).abs()
    assert torch.arccos(dot.clamp(max=1)).max() <= 5 * 0.5 * 0.7072 / 511
    formats.write_gaussians(tmp_path / "b.spz", back)
    again = formats.read_gaussians(tmp_path / "b.spz")
    # what is on a step stays there; 1e-6 for float32 between the two
    assert_close(again, back, atol=1e-6)


def test_spz_version_2(tmp_path):
    payload = zlib.decompress((GOLDEN / "v3.spz").read_bytes(), 31)
    along_axes = [[255, 128, 128], [128, 255, 128], [128, 128, 255], [128, 128, 128]]
    n, xyz = 7, np.array(along_axes + [[0, 128, 128]] * 3, "u1")
    header = struct.pack("<IIIBBBB", 0x5053474E, 2, n, *payload[12:16])
    before, after = payload[16 : 16 + 16 * n], payload[16 + 20 * n :]
    deflate = zlib.compressobj(wbits=31)
    data = deflate.compress(header + before + xyz.tobytes() + after) + deflate.flush()
    (tmp_path / "a.spz").write_bytes(data)
    q = formats.read_gaussians(tmp_path / "a.spz").quaternions
    unit = torch.tensor([[0, 1.0, 0, 0], [0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0]])  # y and z change sign
    assert (q[:4] - unit).abs().max() <= 1 / 127.5 + 1e-6  # a byte's step; zero itself lies between two bytes
    assert torch.equal(q[4], q[6])


def test_splat_round_trip_is_within_its_steps(tmp_path):
    g = format_files.random_gaussians(300, 0)
    formats.write_gaussians(tmp_path / "a.splat", g)
    assert (tmp_path / "a.splat").stat().st_size == 300 * 32
    back = formats.read_gaussians(tmp_path / "a.splat")
    assert torch.equal(back.means, g.means)
    assert (back.log_scales - g.log_scales).abs().max() <= 2e-6  # exp then log in float32, of values up to 5
    assert (back.opacities - g.opacities).abs().max() <= 0.5 / 255 + 1e-6
    shown = (g.sh * 0.28209479177387814 + 0.5).clamp(0, 1)  # a byte holds displayed colours only
    assert (back.sh * 0.28209479177387814 + 0.5 - shown).abs().max() <= 0.5 / 255 + 1e-6
    q = torch.nn.functional.normalize(g.quaternions, dim=1)
    assert (back.quaternions - q).abs().max() <= 1 / 128 + 1e-6  # half a step, a whole one at +1 where bytes end
    formats.write_gaussians(tmp_path / "b.splat", back)
    assert torch.equal(formats.read_gaussians(tmp_path / "b.splat").opacity_logits, back.opacity_logits)


def test_opaque_and_clear_stay_finite(tmp_path):
    g = format_files.random_gaussians(2, 0)
    g.opacity_logits[:] = torch.tensor([-200.0, 200.0])
    for suffix in (".splat", ".spz"):
        formats.write_gaussians(tmp_path / f"a{suffix}", g)
        back = formats.read_gaussians(tmp_path / f"a{suffix}").opacities
        assert back[0] < 0.5 / 255
        assert back[1] > 1 - 0.5 / 255


@pytest.mark.parametrize("suffix", [".splat", ".spz"])
def test_what_the_format_cannot_hold_is_refused(tmp_path, suffix):
    g = format_files.random_gaussians(3, 0)
    g.means[1, 1] = float("nan")
    path = tmp_path / f"a{suffix}"
    with pytest.raises(ValueError, match="found 1 of 3 that are not"):
        formats.write_gaussians(path, g)
    assert list(tmp_path.iterdir()) == []


def test_empty_scenes(tmp_path):
    formats.write_gaussians(tmp_path / "a.spz", empty(1))
    assert formats.read_gaussians(tmp_path / "a.spz").sh.shape == (0, 4, 3)
    with pytest.raises(ValueError, match="at least one Gaussian"):
        formats.write_gaussians(tmp_path / "a.splat", empty())


def test_positions_beyond_24_bits_are_refused(tmp_path):
    g = format_files.random_gaussians(3, 0)
    g.means[0, 0] = 1e8
    with pytest.raises(ValueError, match=r"a\.spz: expected positions within 8388607"):
        formats.write_gaussians(tmp_path / "a.spz", g)


def damaged_spz(data):
    payload = bytearray(zlib.decompress(data, 31))

    def packed(change):
        change(payload)
        deflate = zlib.compressobj(wbits=31)
        return deflate.compress(bytes(payload)) + deflate.flush()

    yield data[:-1]
    yield data[: len(data) // 2]
    yield data[:50] + bytes([data[50] ^ 4]) + data[51:]
    yield data + b"more"
    yield data[:-6] + bytes(6)  # checksum and length
    yield b"NGSP" + data
    yield packed(lambda p: p.__setitem__(slice(8, 12), struct.pack("<I", 8)))
    yield packed(lambda p: p.__setitem__(slice(8, 12), struct.pack("<I", 4_000_000_000)))
    yield packed(lambda p: p.__setitem__(12, 9))
    yield packed(lambda p: p.__setitem__(4, 77))


def test_damaged_spz_is_refused(tmp_path):
    for i, data in enumerate(damaged_spz((GOLDEN / "v3.spz").read_bytes())):
        path = tmp_path / f"{i}.spz"
        path.write_bytes(data)
        with pytest.raises(ValueError, match=rf"{i}\.spz: expected .*found"):
            formats.read_gaussians(path)


@pytest.mark.parametrize("data", [b"", b"1" * 31, b"1" * 33, struct.pack("<3f", 1, float("nan"), 0) + bytes(20)])
def test_damaged_splat_is_refused(tmp_path, data):
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.splat: expected .*found"):
        formats.read_gaussians(tmp_path / "a.splat")


def test_compressed_ply_without_its_chunks_is_refused(tmp_path):
    data = (GOLDEN / "supersplat.compressed.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"element chunk", b"element chink"))
    with pytest.raises(ValueError, match=r"a\.ply: expected one chunk for 256 packed Gaussians, found 0"):
        formats.read_gaussians(tmp_path / "a.ply")
