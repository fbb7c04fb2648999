"""Small files that claim to be huge, in each format: refused in one line, before memory is taken."""

import json
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import format_files
import numpy as np
import pytest
import scene_writers

from splatgraft import formats

TOOLS = format_files.GOLDEN / "tools"
MOST = 64 << 20
"""Bytes: the free megabyte of packed data times what becomes of it, and the code that is loaded."""


def refused(path: Path) -> str:
    """The message with which `path` is refused, without much memory."""
    formats.read_scene(TOOLS / "scene.sog")  # what is loaded at the first use is not the file's
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"expected .*found") as caught:
            formats.read_scene(path)
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def gzip_bomb() -> bytes:
    """A valid .spz of version 2 with 6 million equal Gaussians: 114 MB in 110 kB."""
    n = 6_000_000
    deflate = zlib.compressobj(9, zlib.DEFLATED, 31)
    out = deflate.compress(struct.pack("<IIIBBBB", 0x5053474E, 2, n, 0, 12, 0, 0))
    out += b"".join(deflate.compress(bytes(1_000_000)) for _ in range(19 * n // 1_000_000))
    return out + deflate.flush()


def zstd_bomb() -> bytes:
    zstandard = pytest.importorskip("zstandard")
    n = 6_000_000
    streams = [zstandard.ZstdCompressor().compress(bytes(n * width)) for width in (9, 1, 3, 3, 4)]
    table = b"".join(struct.pack("<QQ", len(s), n * width) for s, width in zip(streams, (9, 1, 3, 3, 4), strict=True))
    return struct.pack("<IIIBBBBI12x", 0x5053474E, 4, n, 0, 12, 0, 5, 32) + table + b"".join(streams)


@pytest.mark.parametrize("make", [gzip_bomb, zstd_bomb])
def test_spz_that_unpacks_without_measure(tmp_path, make: Callable[[], bytes]):
    (tmp_path / "a.spz").write_bytes(make())
    assert "6000000 Gaussians as the header says" in refused(tmp_path / "a.spz")


def test_zip_bomb(tmp_path):
    files = scene_writers.sog_v1(format_files.random_gaussians(20, 1))
    files["meta.json"] += b" " * 60_000_000
    path = scene_writers.write_zip(tmp_path / "a.sog", files, method=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 1_000_000
    assert "meta.json to unpack to at most" in refused(path)


def test_picture_bomb(tmp_path):
    """9,000 x 9,000 equal pixels are a few kB of lossless WebP, and 324 MB unpacked."""
    files = scene_writers.sog_v1(format_files.random_gaussians(20, 1))
    huge = bytearray(files["means_l.webp"])
    # the size stands in the 28 bits behind the signature of the lossless chunk
    at = huge.index(b"VP8L") + 9
    bits = struct.unpack_from("<I", huge, at)[0]
    struct.pack_into("<I", huge, at, bits & 0xF0000000 | 8999 << 14 | 8999)
    files["means_l.webp"] = bytes(huge)
    path = scene_writers.write_zip(tmp_path / "a.sog", files)
    assert "found 9000 x 9000" in refused(path)


@pytest.mark.parametrize("count", [1 << 20, (1 << 28) - 1, 1 << 40, -1, 1.5, None, True, "40"])
def test_sog_that_claims_another_count(tmp_path, count):
    with zipfile.ZipFile(TOOLS / "scene.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    files["meta.json"] = json.dumps(meta | {"count": count}).encode()
    refused(scene_writers.write_zip(tmp_path / "a.sog", files))


@pytest.mark.parametrize("name", ["../secret.webp", "/etc/passwd", "a\\b.webp", "..", ""])
def test_sog_cannot_name_files_elsewhere(tmp_path, name):
    files = scene_writers.sog_v1(format_files.random_gaussians(20, 1))
    meta = json.loads(files["meta.json"])
    meta["quats"]["files"] = [name]
    files["meta.json"] = json.dumps(meta).encode()
    folder = scene_writers.write_folder(tmp_path / "sog", files)
    (tmp_path / "secret.webp").write_bytes(files["quats.webp"])
    refused(folder)


@pytest.mark.parametrize("count", [1 << 20, 1 << 33, -1, 1e9, "40"])
def test_glb_that_claims_another_count(tmp_path, count):
    content, binary = scene_writers.parts_of_glb((TOOLS / "scene.glb").read_bytes())
    for accessor in content["accessors"]:
        accessor["count"] = count
    (tmp_path / "a.glb").write_bytes(scene_writers.glb(content, binary))
    refused(tmp_path / "a.glb")


def test_glb_that_copies_its_gaussians_without_measure(tmp_path):
    content, binary = scene_writers.parts_of_glb((TOOLS / "scene.glb").read_bytes())
    content["nodes"] = [{"children": list(range(1, 9000))}, *({"mesh": 0} for _ in range(9000))]
    (tmp_path / "a.glb").write_bytes(scene_writers.glb(content, binary))
    assert "many copies" in refused(tmp_path / "a.glb")


@pytest.mark.parametrize("children", [[0], [1], list(range(2))])
def test_glb_whose_nodes_form_a_cycle(tmp_path, children):
    content, binary = scene_writers.parts_of_glb((TOOLS / "scene.glb").read_bytes())
    content["nodes"] = [{"children": [1]}, {"children": children}]
    (tmp_path / "a.glb").write_bytes(scene_writers.glb(content, binary))
    assert "without cycles" in refused(tmp_path / "a.glb")


@pytest.mark.parametrize("values", [np.nan, np.inf])
def test_not_a_number_is_kept_or_refused(tmp_path, values):
    """Positions that are no numbers stay in a .glb as in a .ply, and are culled when drawn."""
    content, binary = scene_writers.parts_of_glb((TOOLS / "scene.glb").read_bytes())
    (tmp_path / "a.glb").write_bytes(scene_writers.glb(content, np.float32(values).tobytes() + binary[4:]))
    assert not bool(formats.read_gaussians(tmp_path / "a.glb").means[0].isfinite().all())


@pytest.mark.parametrize(("offset", "value"), [(4, 1 << 20), (16, 1 << 30), (4096, 1 << 30), (4100, 1 << 31)])
def test_ksplat_that_claims_more(tmp_path, offset, value):
    data = bytearray((TOOLS / "scene.level1.ksplat").read_bytes())
    struct.pack_into("<I", data, offset, value)
    (tmp_path / "a.ksplat").write_bytes(data)
    refused(tmp_path / "a.ksplat")


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".glb", ".ksplat", ".splat", ".ply"])
@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"PK\x03\x04", b"\x1f\x8b"])
def test_files_of_another_kind(tmp_path, suffix, content):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    if suffix == ".splat" and len(content) % 32 == 0 and content:
        return
    refused(path)
