"""Our written scenes, read by the formats' own tools and other programs; see golden/written/README.md."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from format_files import GOLDEN, TOOLS, equal, glb, parts_of_glb, random_gaussians
from test_scenes_of_other_tools import BYTE, COMPRESSED, EXACT, GLB, SH_BYTE, SOG, SPLAT, SPZ, assert_within

from splatgraft import formats
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.formats.scenes.sog import nearest_codes, palette, scalar_codes
from splatgraft.formats.scenes.spz import write_spz

WRITTEN = GOLDEN / "written"
# one compressed chunk holds all 40; codes for 120 numbers are exact; bands are not rounded to 4 bits as others do
FINE_SPZ = SPZ | {"means": 1e-6, "bands": 0.5 / 128}
STEPS = {
    "scene.ply": EXACT | {"means": 0.0, "dc": 0.0, "bands": 0.0},
    "scene.compressed.ply": COMPRESSED | {"dc": SH_BYTE},
    "scene.sog": SOG | {"log_scales": 1e-5, "dc": 1e-5, "opacities": BYTE, "bands": 0.02},
    "scene.spz": FINE_SPZ,
    "scene.v3.spz": FINE_SPZ,
    "scene.splat": SPLAT,
    "scene.glb": GLB,
}
BY_SPLAT_TRANSFORM = [name for name in STEPS if name not in ("scene.ply", "scene.glb")]
DECODED = dict.fromkeys(BY_SPLAT_TRANSFORM, EXACT) | {
    "scene.splat": EXACT | {"ellipsoids": 0.03},  # it takes a byte b for 2 b / 255 - 1, others for (b - 128) / 128
}


@pytest.fixture(scope="module")
def original() -> Gaussians:
    return formats.read_gaussians(TOOLS / "scene.ply")


def write(path: Path, gaussians: Gaussians) -> Path:
    if path.name == "scene.v3.spz":
        write_spz(path, gaussians, version=3)
    else:
        formats.write_gaussians(path, gaussians)
    return path


@pytest.mark.parametrize("name", STEPS)
def test_our_reader_finds_the_scene_within_the_steps(original, tmp_path, name):
    assert_within(original, formats.read_gaussians(write(tmp_path / name, original)), STEPS[name])


@pytest.mark.parametrize("name", BY_SPLAT_TRANSFORM)
def test_the_recorded_tool_read_what_is_written_today(original, tmp_path, name):
    """Our present file decodes like the tool's decoding of the recorded one."""
    theirs = formats.read_gaussians(WRITTEN / f"{name}.decoded.ply")
    assert_within(theirs, formats.read_gaussians(write(tmp_path / name, original)), DECODED[name])
    assert_within(theirs, formats.read_gaussians(WRITTEN / name), DECODED[name])


def test_the_recorded_tool_and_our_reader_decode_spz_2_alike():
    theirs = formats.read_gaussians(WRITTEN / "scene.v2.spz.decoded.ply")
    # w is the root of what is nearly 0
    assert_within(theirs, formats.read_gaussians(WRITTEN / "scene.v2.spz"), EXACT | {"ellipsoids": 1e-4})


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".spz", ".splat", ".glb"])
def test_every_degree_and_several_chunks(tmp_path, suffix):
    for degree in range(4):
        g = random_gaussians(600, degree)
        formats.write_gaussians(tmp_path / f"a{suffix}", g)
        back = formats.read_gaussians(tmp_path / f"a{suffix}")
        assert back.sh_degree == (0 if suffix == ".splat" else degree)
        # 256 codes, or steps of a byte, for numbers of up to 1
        assert_within(g, back, {"dc": 0.03, "bands": 0.03})


def test_opaque_and_clear_stay_finite(tmp_path):
    g = random_gaussians(2, 0)
    g.opacity_logits[:] = torch.tensor([-200.0, 200.0])
    for suffix in (".splat", ".spz", ".sog", ".glb"):
        formats.write_gaussians(tmp_path / f"a{suffix}", g)
        back = formats.read_gaussians(tmp_path / f"a{suffix}").opacity_logits.sort().values
        assert bool(back.isfinite().all())
        assert back.sigmoid()[0] < 0.5 / 255
        assert back.sigmoid()[1] > 1 - 0.5 / 255


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".glb"])
def test_up_and_size_are_read_back(tmp_path, suffix):
    metadata = formats.SceneMetadata(up=(0.0, -0.6, 0.8), metres_per_unit=0.21)
    formats.write_gaussians(tmp_path / f"a{suffix}", random_gaussians(20), metadata=metadata)
    found = formats.read_scene(tmp_path / f"a{suffix}")
    assert found.metadata.up == pytest.approx((0, -0.6, 0.8))
    assert found.metadata.metres_per_unit == pytest.approx(0.21)
    assert any("one unit is 0.21 m" in sentence for sentence in found.said())


@pytest.mark.parametrize("comment", ["up: 0 0 0", "up: a b c", "metres_per_unit: 0", "metres_per_unit: -1"])
def test_comments_that_state_nothing(tmp_path, comment):
    formats.write_gaussians(tmp_path / "a.ply", random_gaussians(2, 0))
    data = (tmp_path / "a.ply").read_bytes().replace(b"element vertex", f"comment {comment}\nelement vertex".encode())
    (tmp_path / "a.ply").write_bytes(data)
    found = formats.read_scene(tmp_path / "a.ply")
    assert found.metadata.up is None
    assert found.metadata.metres_per_unit is None


@pytest.mark.parametrize("suffix", [".compressed.ply", ".glb", ".sog", ".splat"])
def test_what_a_format_cannot_hold_is_refused(tmp_path, suffix):
    broken = random_gaussians(3, 0)
    broken.means[1, 1] = float("nan")
    for g, found in ((empty(), "at least one Gaussian"), (broken, "found 1 of 3 that are not")):
        with pytest.raises(ValueError, match=rf"a\{suffix}: expected .*{found}"):
            formats.write_gaussians(tmp_path / f"a{suffix}", g)
    assert list(tmp_path.iterdir()) == []


def test_spz_may_be_empty_and_has_bounds(tmp_path):
    formats.write_gaussians(tmp_path / "a.spz", empty(1))
    assert formats.read_gaussians(tmp_path / "a.spz").sh.shape == (0, 4, 3)
    g = random_gaussians(3, 0)
    g.means[0, 0] = 1e8
    with pytest.raises(ValueError, match=r"a\.spz: expected positions within 8388607"):
        formats.write_gaussians(tmp_path / "a.spz", g)
    with pytest.raises(ValueError, match=r"a\.spz: expected \.spz version 3 or 4 to write, found 2"):
        write_spz(tmp_path / "a.spz", g, version=2)


def test_the_glb_is_what_the_specification_asks_for(original, tmp_path):
    """The JSON agrees with that of splat-transform 3.7.0, and the values are right without our reader."""
    formats.write_gaussians(tmp_path / "a.glb", original)
    content, binary = parts_of_glb((tmp_path / "a.glb").read_bytes())
    theirs, _ = parts_of_glb((TOOLS / "scene.glb").read_bytes())
    ours_primitive, their_primitive = (c["meshes"][0]["primitives"][0] for c in (content, theirs))
    assert ours_primitive["extensions"] == their_primitive["extensions"]
    assert set(ours_primitive["attributes"]) == set(their_primitive["attributes"])
    assert content["extensionsUsed"] == theirs["extensionsUsed"]

    def values(name: str) -> np.ndarray:
        accessor = content["accessors"][ours_primitive["attributes"][name]]
        view = content["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        if name == "COLOR_0":
            assert (accessor["componentType"], accessor["normalized"]) == (5121, True)
            return np.frombuffer(binary, "u1", 160, view["byteOffset"]).reshape(40, 4) / 255
        assert (accessor["componentType"], accessor["count"], view["byteOffset"] % 4) == (5126, 40, 0)
        return np.frombuffer(binary, "<f4", 40 * width, view["byteOffset"]).reshape(40, width)

    positions = values("POSITION")
    accessor = content["accessors"][ours_primitive["attributes"]["POSITION"]]
    assert accessor["min"] == pytest.approx(positions.min(0))
    assert accessor["max"] == pytest.approx(positions.max(0))
    # x left, y up: both turned
    assert np.allclose(positions, original.means.numpy() * [-1, -1, 1], atol=1e-6)
    assert np.allclose(values("KHR_gaussian_splatting:SCALE"), original.scales.numpy(), rtol=1e-5)
    assert np.allclose(values("KHR_gaussian_splatting:OPACITY")[:, 0], original.opacities.numpy(), atol=1e-6)
    shown = (original.sh[:, 0] * 0.28209479 + 0.5).clamp(0, 1).numpy()
    assert np.allclose(values("COLOR_0")[:, :3], shown, atol=0.51 / 255)
    rotation = values("KHR_gaussian_splatting:ROTATION")
    assert np.allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-5)
    assert json.dumps(content["asset"]) == '{"version": "2.0", "generator": "splatgraft"}'
    # up is given in the axes of the positions
    formats.write_gaussians(tmp_path / "a.glb", original, metadata=formats.SceneMetadata(up=(0.48, -0.6, 0.64)))
    content, _ = parts_of_glb((tmp_path / "a.glb").read_bytes())
    assert content["asset"]["extras"] == {"up": pytest.approx([-0.48, 0.6, 0.64])}
    # another program's extras may have any meaning
    content["asset"] = {"version": "2.0", "generator": "other", "extras": {"up": "Y"}}
    (tmp_path / "b.glb").write_bytes(glb(content, binary))
    assert formats.read_scene(tmp_path / "b.glb").metadata.up is None


def test_meta_json_of_sog_and_the_same_bytes_twice(tmp_path):
    metadata = formats.SceneMetadata(up=(0.0, 0.0, 1.0), metres_per_unit=0.25)
    for name in ("b.sog", "a.sog"):
        formats.write_gaussians(tmp_path / name, random_gaussians(2000, 2), metadata=metadata)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        meta = json.loads(archive.read("meta.json"))
        assert {name for part in meta.values() if isinstance(part, dict) for name in part.get("files", [])} == {
            entry for entry in archive.namelist() if entry != "meta.json"
        }
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 2000, 2)
    assert meta["splatgraft"] == {"up": [0, 0, 1], "metres_per_unit": 0.25}


def test_scalar_codes_are_nearly_the_best():
    """Lloyd's codes are closer to the values than uniform steps are."""
    values = np.random.default_rng(0).normal(size=20_000) ** 3
    codes = scalar_codes(values)
    error = np.square(codes[nearest_codes(values, codes)] - values).mean()
    steps = np.linspace(values.min(), values.max(), 256)
    uniform = np.square(steps[nearest_codes(values, steps.astype(np.float32))] - values).mean()
    assert error < 0.25 * uniform
    # the chosen code is the nearest one
    some = values[:500]
    off = np.abs(some[:, None] - codes)
    assert (np.abs(codes[nearest_codes(some, codes)] - some) <= off.min(1) + 1e-5).all()  # codes in float32


def test_a_palette_keeps_to_its_size_and_beats_one_of_random_rows():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(50, 9, generator=generator)[torch.randint(50, (9000,), generator=generator)]
    rows = rows + 0.1 * torch.randn(9000, 9, generator=generator)
    entries, labels = palette(rows, 1024)
    assert len(entries) <= 1024
    assert labels.max() < len(entries)
    error = (entries[labels] - rows).square().mean()
    some = rows[torch.randperm(9000, generator=generator)[:1024]]
    assert error < (torch.cdist(rows, some).amin(1).square() / 9).mean()


def test_suffixes_in_capitals_and_others(tmp_path):
    g = random_gaussians(3, 1)
    formats.write_gaussians(tmp_path / "A.PLY", g)
    assert equal(formats.read_gaussians(tmp_path / "A.PLY"), g)
    with pytest.raises(ValueError, match=r"a\.obj: expected a scene that ends in \.ply, .*found '\.obj'"):
        formats.write_gaussians(tmp_path / "a.obj", g)
