"""Damaged files: for any bytes a reader returns a value or raises a one-line ValueError that names the file.

Small files that claim to be huge are refused before memory is taken.
"""

import json
import re
import shutil
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import format_files
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatgraft import formats
from splatgraft.core.images import read_alpha, read_mask, read_rgb, stored_size

FEW, MANY = 6, 60
"""Number of examples of each case; many in `make test-all`."""
FROM_TOOLS = ("scene.sog", "scene.glb", "scene.v3.spz", "scene.v4.spz", "scene.level0.ksplat", "scene.level2.ksplat")

LIES = b"0 -1 1e9 nan 999999999999 18446744073709551615 inf \xff\xfe null [] {}".split()
BINARY_LIES = [struct.pack("<Q", value) for value in (0, 1, 2**16, 2**31, 2**32 - 1, 2**63, 2**64 - 1)]
BINARY_LIES += [struct.pack("<f", float("nan")), struct.pack("<d", float("inf")), struct.pack("<d", 1e300)]


@st.composite
def damages(draw) -> Callable[[bytes], bytes]:
    """Damage bytes one to three times: cut, flip bits, replace, repeat or remove a stretch, or write a wrong number."""
    kinds = st.sampled_from(["cut", "flip", "replace", "repeat", "remove", "number", "lie", "append"])
    step = st.tuples(kinds, st.floats(0, 1), st.binary(min_size=1, max_size=12), st.integers(1, 24))
    steps = draw(st.lists(step, min_size=1, max_size=3))

    def apply(data: bytes) -> bytes:
        for kind, where, noise, length in steps:
            at = int(where * max(len(data) - 1, 0))
            if kind == "cut":
                data = data[:at]
            elif kind == "flip" and data:
                data = data[:at] + bytes([data[at] ^ (1 << length % 8)]) + data[at + 1 :]
            elif kind == "replace":
                data = data[:at] + noise + data[at + len(noise) :]
            elif kind == "repeat":
                data = data[: at + length] + data[at:]
            elif kind == "remove":
                data = data[:at] + data[at + length :]
            elif kind == "number":
                start = next((i for i in range(at, len(data)) if chr(data[i]) in "0123456789"), at)
                end = next((i for i in range(start, len(data)) if chr(data[i]) not in "0123456789.e-+"), len(data))
                data = data[:start] + LIES[length % len(LIES)] + data[end:]
            elif kind == "lie":
                lie = BINARY_LIES[length % len(BINARY_LIES)]
                data = data[:at] + lie + data[at + len(lie) :]
            else:
                data = data + noise
        return data

    return apply


def assert_refused(message: str, named: Path) -> None:
    assert str(named) in message, message
    assert "\n" not in message
    assert re.search("expected .*found", message), message


@pytest.fixture(scope="module")
def seeds(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    g = format_files.random_gaussians(20, 1)
    for suffix in (".ply", ".splat", ".spz"):
        formats.write_gaussians(folder / f"scene{suffix}", g)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in names)
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "\n".join(" ".join(["0.25"] * len(names)) for _ in range(3))
    (folder / "ascii.ply").write_text(f"{header}{rows}\n3 0 1 2\n")
    big = header.replace("ascii", "binary_big_endian").encode() + np.ones((3, len(names)), ">f4").tobytes()
    (folder / "faces.ply").write_bytes(big + struct.pack(">B3i", 3, 0, 1, 2))
    formats.write_points(folder / "points.ply", torch.randn(9, 3), torch.rand(9, 3))
    format_files.write_transforms(folder / "nerf", {"w": 24, "h": 16, "k1": 0.01, "ply_file_path": "points.ply"})
    shutil.copy(folder / "points.ply", folder / "nerf")
    cameras = b'[{"id": 0, "img_name": "a", "width": 24, "height": 16, "position": [0, 1, 2], '
    cameras += b'"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 20.5, "fy": 21.5}]'
    (folder / "cameras.json").write_bytes(cameras)
    for text in (False, True):
        root = folder / ("colmap_text" if text else "colmap")
        camera = ("OPENCV", 24, 16, (20.0, 21.0, 12.0, 8.0, 0.01, 0.0, 0.0, 0.0))
        format_files.write_colmap(root / "sparse" / "0", text=text, camera=camera)
        for name in ("a.png", "b.png"):
            format_files.write_photo(root / "images" / name)
    shutil.copy(format_files.GOLDEN / "supersplat.compressed.ply", folder)
    for name in FROM_TOOLS:
        shutil.copy(format_files.GOLDEN / "tools" / name, folder)
    (folder / "sog").mkdir()
    for name, data in format_files.files_of_zip(format_files.TOOLS / "scene.sog").items():
        (folder / "sog" / name).write_bytes(data)
    for i in range(2):
        format_files.write_photo(folder / "nerf" / "masks" / f"{i:04d}.png")
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        format_files.write_photo(folder / "pictures" / f"photo.{suffix}")
    return folder


def fuzz(seeds: Path, relative: str, reader: Callable[[Path], object], damage: Callable[[bytes], bytes]) -> None:
    """Damage the file in place, read it, and restore it."""
    path = seeds / relative
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    size = path.stat().st_size + 50_000  # the other files of the capture
    tracemalloc.start()
    try:
        reader(path)
    except ValueError as error:
        assert_refused(str(error), seeds)
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        path.write_bytes(whole)
    # a deflated byte may really hold 1032; text becomes objects of about 60 bytes per word; 4 MB for code and headers
    assert peak < 1100 * size + 4_000_000


anything = st.one_of(damages(), damages(), damages(), st.binary(max_size=200).map(lambda noise: lambda data: noise))
DERANDOMIZED = {"deadline": None, "derandomize": True, "suppress_health_check": [HealthCheck.function_scoped_fixture]}


def reader_of(seeds: Path, name: str) -> Callable[[Path], object]:
    if name.startswith("sog/"):
        return lambda path: formats.read_scene(path.parent / "meta.json")
    if name.startswith("nerf/"):
        return lambda path: [
            (c.image(i), c.mask(i)) for c in [formats.read_capture(seeds / "nerf")] for i in range(len(c))
        ]
    if name.startswith("colmap"):
        return lambda path: formats.read_capture(seeds / name.split("/", maxsplit=1)[0])
    if name.startswith("pictures/"):
        return lambda path: [reader(path) for reader in (stored_size, read_rgb, read_mask, read_alpha)]
    return {"points.ply": formats.read_points, "cameras.json": formats.read_cameras}.get(name, formats.read_scene)


FILES = (
    *("scene.ply", "scene.splat", "scene.spz", "ascii.ply", "faces.ply", "supersplat.compressed.ply", *FROM_TOOLS),
    *("sog/meta.json", "sog/means_u.webp", "sog/quats.webp", "sog/shN_centroids.webp", "sog/shN_labels.webp"),
    *("points.ply", "cameras.json", "nerf/transforms.json", "nerf/points.ply"),
    *("nerf/images/0001.png", "nerf/masks/0001.png"),
    *(f"colmap/sparse/0/{stem}.bin" for stem in ("cameras", "images", "points3D")),
    *(f"colmap_text/sparse/0/{stem}.txt" for stem in ("cameras", "images", "points3D")),
    *(f"pictures/photo.{suffix}" for suffix in ("png", "jpg", "webp", "tif", "bmp")),
)


@pytest.mark.parametrize("name", FILES)
@given(damage=anything)
@settings(max_examples=FEW, **DERANDOMIZED)
def test_damaged(seeds, name, damage):
    fuzz(seeds, name, reader_of(seeds, name), damage)


@pytest.mark.long
@pytest.mark.parametrize("name", FILES)
@given(damage=anything)
@settings(max_examples=MANY, **DERANDOMIZED)
def test_damaged_in_many_ways(seeds, name, damage):
    fuzz(seeds, name, reader_of(seeds, name), damage)


@given(damage=anything)
@settings(max_examples=FEW, **DERANDOMIZED)
def test_json_of_glb(seeds, damage):
    """Damage only the JSON; damage of the whole file seldom leaves valid JSON."""
    data = (seeds / "scene.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]

    def inside(whole: bytes) -> bytes:
        text = damage(whole[20 : 20 + length])
        binary = whole[20 + length :]
        return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A) + text + binary

    fuzz(seeds, "scene.glb", formats.read_scene, inside)


def refused(path: Path) -> str:
    """Return the message that refuses `path`, and check that little memory was used."""
    formats.read_scene(format_files.TOOLS / "scene.sog")  # modules loaded at the first use are not the file's memory
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="expected") as caught:
            formats.read_scene(path)
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()
    assert_refused(str(caught.value), path)
    return str(caught.value)


def gzip_bomb() -> bytes:
    """Return a valid .spz of version 2 with 6 million equal Gaussians: 114 MB in 110 kB."""
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


def test_spz_with_a_wrong_header_or_checksum(tmp_path):
    data = (format_files.GOLDEN / "v3.spz").read_bytes()
    payload = zlib.decompress(data, 31)

    def packed(at: int, value: bytes) -> bytes:
        return zlib.compress(payload[:at] + value + payload[at + len(value) :], wbits=31)

    counts = [packed(8, struct.pack("<I", count)) for count in (8, 4_000_000_000)]
    flipped, unchecked = data[:50] + bytes([data[50] ^ 4]) + data[51:], data[:-6] + bytes(6)
    for content in (data[:-1], flipped, unchecked, *counts, packed(12, b"\x09"), packed(4, b"\x4d")):
        (tmp_path / "a.spz").write_bytes(content)
        refused(tmp_path / "a.spz")


def test_picture_bomb(tmp_path):
    """Check a picture of 9,000 x 9,000 equal pixels: a few kB of lossless WebP, and 324 MB unpacked."""
    files = format_files.files_of_zip(format_files.TOOLS / "scene.sog")
    huge = bytearray(files["means_l.webp"])
    # the 28 bits after the signature of the lossless chunk hold the size
    at = huge.index(b"VP8L") + 9
    bits = struct.unpack_from("<I", huge, at)[0]
    struct.pack_into("<I", huge, at, bits & 0xF0000000 | 8999 << 14 | 8999)
    path = format_files.write_zip(tmp_path / "a.sog", files | {"means_l.webp": bytes(huge)})
    assert "found 9000 x 9000" in refused(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
def test_sog_that_unpacks_without_measure(tmp_path, method):
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("meta.json", b" " * (128 << 20))
    assert "found 134217728 bytes" in refused(path)
    # the same with a smaller size stated, 24 bytes into its entry of the directory
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, 1000)
    path.write_bytes(data)
    refused(path)


def test_sog_with_another_meta_json_or_names_of_files_elsewhere(tmp_path, seeds):
    files = format_files.files_of_zip(format_files.TOOLS / "scene.sog")
    meta = json.loads(files["meta.json"])
    for change in ({"count": 1 << 20}, {"count": -1}, {"count": None}, {"version": 1}, {"quats": {}}):
        changed = {"meta.json": json.dumps(meta | change).encode()}
        refused(format_files.write_zip(tmp_path / "a.sog", files | changed))
    folder = tmp_path / "sog"
    shutil.copytree(seeds / "sog", folder)
    (tmp_path / "secret.webp").write_bytes((folder / "quats.webp").read_bytes())
    for name in ("../secret.webp", "/etc/passwd", "a\\b.webp", ""):
        meta["quats"]["files"] = [name]
        (folder / "meta.json").write_text(json.dumps(meta))
        refused(folder)


def test_glb_with_other_counts_nodes_or_numbers(tmp_path):
    content, binary = format_files.parts_of_glb((format_files.TOOLS / "scene.glb").read_bytes())
    path = tmp_path / "a.glb"
    for count in (1 << 33, -1, "40"):
        accessors = [accessor | {"count": count} for accessor in content["accessors"]]
        path.write_bytes(format_files.glb(content | {"accessors": accessors}, binary))
        refused(path)
    for children in ([1], [0, 1]):
        nodes = [{"children": [1]}, {"children": children}]
        path.write_bytes(format_files.glb(content | {"nodes": nodes}, binary))
        assert "without cycles" in refused(path)
    # positions that are no numbers stay in a .glb as in a .ply, and are culled when drawn
    path.write_bytes(format_files.glb(content, np.float32(np.nan).tobytes() + binary[4:]))
    assert not bool(formats.read_gaussians(path).means[0].isfinite().all())


@pytest.mark.parametrize(("offset", "value"), [(4, 1 << 20), (16, 1 << 30), (4096, 1 << 30)])
def test_ksplat_that_claims_more(tmp_path, offset, value):
    data = bytearray((format_files.TOOLS / "scene.level1.ksplat").read_bytes())
    struct.pack_into("<I", data, offset, value)
    (tmp_path / "a.ksplat").write_bytes(data)
    refused(tmp_path / "a.ksplat")


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".glb", ".ksplat", ".splat", ".ply"])
def test_files_of_another_kind(tmp_path, suffix):
    for content in (b"", b"\0" * 5001, b"PK\x03\x04", b"\x1f\x8b", b"1" * 33):
        (tmp_path / f"a{suffix}").write_bytes(content)
        refused(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("read", [formats.read_gaussians, formats.read_capture, formats.read_cameras])
@pytest.mark.parametrize("name", ["a.ply", "a.json", "none", "a" * 300])
def test_what_is_not_there_is_named(tmp_path, read, name):
    with pytest.raises(ValueError, match="expected") as caught:
        read(tmp_path / name)
    assert_refused(str(caught.value), tmp_path / name)


def test_splat_of_no_numbers_and_compressed_ply_without_its_chunks(tmp_path):
    (tmp_path / "a.splat").write_bytes(struct.pack("<3f", 1, float("nan"), 0) + bytes(20))
    assert "is it another format?" in refused(tmp_path / "a.splat")
    data = (format_files.GOLDEN / "supersplat.compressed.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"element chunk", b"element chink"))
    assert "expected an element 'chunk', found ['chink'" in refused(tmp_path / "a.ply")
