"""Broken files: for any bytes a reader returns a value or raises a one-line ValueError that names the file."""

import shutil
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import format_files
import numpy as np
import pytest
import scene_writers
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatgraft import formats
from splatgraft.core.images import read_alpha, read_mask, read_rgb, stored_size

EXAMPLES = 60
LEVELS = tuple(f"scene.level{level}.ksplat" for level in range(3))
FROM_TOOLS = ("scene.sog", "scene.glb", "scene.v4.spz", *LEVELS)
REST = ("v1.spz", *FROM_TOOLS)

LIES = [
    b"0",
    b"-1",
    b"1e9",
    b"nan",
    b"999999999999",
    b"18446744073709551615",
    b"inf",
    b"\xff\xfe",
    b"null",
    b"[]",
    b"{}",
]
BINARY_LIES = [struct.pack("<Q", value) for value in (0, 1, 2**16, 2**31, 2**32 - 1, 2**63, 2**64 - 1)] + [
    struct.pack("<f", float("nan")),
    struct.pack("<d", float("inf")),
    struct.pack("<d", 1e300),
]


@st.composite
def damages(draw) -> Callable[[bytes], bytes]:
    """One to three of: cut, flipped bits, a stretch replaced, repeated or removed, a number replaced by a lie."""
    steps = draw(
        st.lists(
            st.tuples(
                st.sampled_from(["cut", "flip", "replace", "repeat", "remove", "number", "lie", "append"]),
                st.floats(0, 1),
                st.binary(min_size=1, max_size=12),
                st.integers(1, 24),
            ),
            min_size=1,
            max_size=3,
        )
    )

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


def check(read: Callable[[], object], named: Path, size: int) -> None:
    tracemalloc.start()
    try:
        read()
    except ValueError as error:
        message = str(error)
        assert str(named) in message, message
        assert "\n" not in message
        assert "expected" in message
        assert "found" in message
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # a deflated byte may honestly hold 1032; text becomes objects of about 60 bytes per word; 4 MB for code and headers
    assert peak < 1100 * size + 4_000_000


@pytest.fixture(scope="module")
def seeds(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    g = format_files.random_gaussians(20, 1)
    for suffix in (".ply", ".splat", ".spz"):
        formats.write_gaussians(folder / f"scene{suffix}", g)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\nelement vertex 3\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n3 0 1 2\n"
    (folder / "ascii.ply").write_text(header + "\n".join(" ".join(["0.25"] * len(names)) for _ in range(3)) + "\n")
    (folder / "faces.ply").write_bytes(
        header.replace("ascii", "binary_big_endian").encode()[: -len("3 0 1 2\n")]
        + struct.pack(">B3i", 3, 0, 1, 2)
        + np.ones((3, len(names)), ">f4").tobytes()
    )
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
    g = format_files.random_gaussians(20, 1)
    scene_writers.write_folder(folder / "sog", scene_writers.sog_v1(g))
    (folder / "v1.spz").write_bytes(
        scene_writers.spz_of_version_1(g.means.numpy(), extensions=scene_writers.coordinate_system(7), flags=2)
    )
    for i in range(2):
        format_files.write_photo(folder / "nerf" / "masks" / f"{i:04d}.png")
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        format_files.write_photo(folder / "pictures" / f"photo.{suffix}")
    return folder


def fuzz(seeds: Path, relative: str, reader: Callable[[Path], object], damage: Callable[[bytes], bytes]) -> None:
    """The file damaged in place, read, and put back."""
    path = seeds / relative
    whole = path.read_bytes()
    broken = damage(whole)
    path.write_bytes(broken)
    try:
        check(lambda: reader(path), seeds, len(broken) + 50_000)  # the other files of the capture
    finally:
        path.write_bytes(whole)


anything = st.one_of(damages(), damages(), damages(), st.binary(max_size=200).map(lambda noise: lambda data: noise))
fuzzed = settings(
    max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.parametrize(
    "name",
    ["scene.ply", "scene.splat", "scene.spz", "ascii.ply", "faces.ply", "supersplat.compressed.ply", *REST],
)
@given(damage=anything)
@fuzzed
def test_scenes(seeds, name, damage):
    fuzz(seeds, name, formats.read_scene, damage)


@pytest.mark.parametrize("name", ["meta.json", "means_u.webp", "quats.webp", "shN_centroids.webp", "shN_labels.webp"])
@given(damage=anything)
@fuzzed
def test_folder_of_pictures(seeds, name, damage):
    fuzz(seeds, f"sog/{name}", lambda path: formats.read_scene(path.parent / "meta.json"), damage)


@given(damage=anything)
@fuzzed
def test_json_of_glb(seeds, damage):
    """Damage inside the JSON alone, which damage of the whole file seldom leaves to be JSON."""
    data = (seeds / "scene.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]

    def inside(whole: bytes) -> bytes:
        text = damage(whole[20 : 20 + length])
        binary = whole[20 + length :]
        return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A) + text + binary

    fuzz(seeds, "scene.glb", formats.read_scene, inside)


@pytest.mark.parametrize("name", ["points.ply", "ascii.ply", "scene.ply"])
@given(damage=anything)
@fuzzed
def test_points(seeds, name, damage):
    fuzz(seeds, name, formats.read_points, damage)


@pytest.mark.parametrize(
    "name", ["nerf/transforms.json", "nerf/points.ply", "nerf/images/0001.png", "nerf/masks/0001.png"]
)
@given(damage=anything)
@fuzzed
def test_transforms(seeds, name, damage):
    def read(path: Path) -> None:
        capture = formats.read_capture(seeds / "nerf")
        for i in range(len(capture)):
            capture.image(i), capture.mask(i)

    fuzz(seeds, name, read, damage)


@pytest.mark.parametrize("name", ["nerf/transforms.json", "cameras.json"])
@given(damage=anything)
@fuzzed
def test_cameras(seeds, name, damage):
    fuzz(seeds, name, formats.read_cameras, damage)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("root", ["colmap", "colmap_text"])
@given(damage=anything)
@fuzzed
def test_colmap(seeds, root, stem, damage):
    suffix = "bin" if root == "colmap" else "txt"
    fuzz(seeds, f"{root}/sparse/0/{stem}.{suffix}", lambda path: formats.read_capture(seeds / root), damage)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "bmp"])
@given(damage=anything)
@fuzzed
def test_pictures(seeds, suffix, damage):
    def read(path: Path) -> None:
        for reader in (stored_size, read_rgb, read_mask, read_alpha):
            reader(path)

    fuzz(seeds, f"pictures/photo.{suffix}", read, damage)
