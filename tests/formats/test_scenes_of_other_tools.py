"""Scenes written by published tools, compared with their original .ply; see golden/tools/README.md."""

from dataclasses import replace

import format_files
import numpy as np
import pytest
import torch
from format_files import GOLDEN, TOOLS

from splatgraft import formats
from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.axes import change_axes, rdf_from

EXACT = {"means": 1e-6, "log_scales": 1e-6, "ellipsoids": 1e-5, "opacities": 1e-6, "dc": 1e-6, "bands": 1e-6}
GLB = EXACT | {"log_scales": 3e-6, "opacities": 3e-6}  # exponentials and their inverses in float32
BYTE = 0.5 / 255
"""Half a step of a byte of [0, 1]."""
SH_BYTE = BYTE / 0.2820948
"""Half a step of a colour's byte, as band 0."""
SPZ = {
    "means": 0.5 / 4096,  # 12 fractional bits
    "log_scales": 0.5 / 16,
    "ellipsoids": 0.015,  # 9 bits and a sign; twice the difference of the axes times the angle
    "opacities": BYTE,
    "dc": BYTE / 0.15,
    "bands": 8.5 / 128,  # writers round bands 2 and 3 to 4 bits
}
COMPRESSED = {
    "means": 3e-3,  # 10 and 11 bits of an extent of 5
    "log_scales": 1.5e-3,
    "ellipsoids": 0.015,
    "opacities": BYTE,
    "dc": SH_BYTE,
    "bands": 4 / 256,
}
# the code books have 256 values for 120 numbers; positions are 16 bits of logarithms over 2.7, times 1 + |x| of up to 4
SOG = {"means": 9e-5, "log_scales": 1e-2, "ellipsoids": 0.06, "opacities": 2 * BYTE, "dc": 3e-3}
SPLAT = {"means": 1e-6, "log_scales": 1e-6, "ellipsoids": 0.1, "opacities": 2 * BYTE, "dc": 2 * SH_BYTE}
HALF = {"means": 1e-4, "log_scales": 1e-3, "ellipsoids": 0.015, "opacities": 2 * BYTE, "dc": 2 * SH_BYTE}
STEPS = {
    "scene.gsplat.ply": EXACT,
    "scene.glb": GLB,
    "scene.log_scales.glb": GLB,
    "scene.v3.spz": SPZ,
    "scene.v4.spz": SPZ,
    "scene.compressed.ply": COMPRESSED,
    "scene.gsplat.compressed.ply": COMPRESSED,
    "scene.sog": SOG,
    "scene.gsplat.splat": SPLAT,
    "scene.level0.ksplat": SPLAT,
    "scene.level1.ksplat": HALF | {"bands": 5e-4},
    "scene.level2.ksplat": HALF | {"bands": 6e-3},  # bytes of [-1.2, 1.2]
}


@pytest.fixture(scope="module")
def original() -> Gaussians:
    return formats.read_gaussians(TOOLS / "scene.ply")


def matched(original: Gaussians, found: Gaussians) -> Gaussians:
    """Return `found` in the original's order, because most tools sort."""
    assert found.count == original.count
    nearest = torch.cdist(original.means, found.means).argmin(1)
    assert len(nearest.unique()) == original.count
    return found.select(nearest)


def assert_within(original: Gaussians, found: Gaussians, steps: dict[str, float]) -> None:
    found = matched(original, found)
    k = found.sh.shape[1]
    # an ellipsoid is equal to itself with its own axes reversed
    ellipsoids = [
        g.rotations @ torch.diag(torch.tensor([1.0, 2, 3])) @ g.rotations.transpose(1, 2) for g in (original, found)
    ]
    differences = {
        "means": original.means - found.means,
        "log_scales": original.log_scales - found.log_scales,
        "ellipsoids": ellipsoids[0] - ellipsoids[1],
        "opacities": original.opacities - found.opacities,
        "dc": original.sh[:, 0] - found.sh[:, 0],
        "bands": original.sh[:, 1:k] - found.sh[:, 1:],
    }
    for name, step in steps.items():
        # a hundredth for values in float32
        worst = float(differences[name].abs().amax()) if differences[name].numel() else 0.0
        assert worst <= step * 1.01, f"{name}: {worst} above {step}"


@pytest.mark.parametrize("name", STEPS)
def test_values_are_those_of_the_original(original, name):
    assert_within(original, formats.read_scene(TOOLS / name).gaussians, STEPS[name])


def test_sog_is_decoded_as_its_own_tool_decodes_it():
    ours = formats.read_gaussians(TOOLS / "scene.sog")
    theirs = formats.read_gaussians(TOOLS / "scene.sog.ply")
    assert_within(theirs, ours, EXACT | {"means": 3e-6})  # exponentials in float32 and float64


def test_sog_as_a_folder_or_its_meta_json(original, tmp_path):
    (tmp_path / "scene").mkdir()
    for name, data in format_files.files_of_zip(TOOLS / "scene.sog").items():
        (tmp_path / "scene" / name).write_bytes(data)
    for path in (tmp_path / "scene", tmp_path / "scene" / "meta.json"):
        assert formats.is_scene(path)
        assert_within(original, formats.read_gaussians(path), SOG)
        assert len(formats.scene_files(path)) == 8
    assert not formats.is_scene(tmp_path)


def decoded_by_gsply(name: str) -> Gaussians:
    """Return a scene of golden/ as gsply 0.4.6 (MIT) decoded it, from `format_files.random_gaussians(7, 2, seed=5)`."""
    with np.load(GOLDEN / f"{name}.npz") as arrays:
        return Gaussians(**{key: torch.from_numpy(arrays[key]) for key in arrays.files})


@pytest.mark.parametrize(("name", "axes"), [("supersplat.compressed.ply", "RDF"), ("v3.spz", "RUB")])
def test_another_reader_decodes_the_same(name, axes):
    theirs = change_axes(decoded_by_gsply(name), rdf_from(axes))
    # float32 sums of values up to 10
    assert_within(theirs, formats.read_gaussians(GOLDEN / name), dict.fromkeys(EXACT, 2e-6) | {"ellipsoids": 2.4e-5})


def test_spz_that_was_written_without_turning_the_axes(original):
    path = TOOLS / "scene.unturned.spz"
    assert formats.read_scene(path).axes == "RUB"
    assert_within(original, formats.read_scene(path, axes="rdf").gaussians, SPZ)


@pytest.mark.parametrize("axes", ["RDF", "RUF", "UFR"])
def test_changed_axes_show_the_same_scene(original, axes):
    """Mirrored cameras see a mirrored scene: colours along mirrored directions, ellipsoids mirrored."""
    matrix = rdf_from(axes)
    turned = change_axes(original, matrix)
    torch.testing.assert_close(turned.means, original.means @ matrix.T)
    covariances = matrix @ original.covariances @ matrix.T
    torch.testing.assert_close(turned.covariances, covariances, atol=1e-6, rtol=1e-4)  # float32
    directions = torch.nn.functional.normalize(original.means, dim=1)
    torch.testing.assert_close(
        spherical_harmonics.colors(turned.sh, directions @ matrix.T),
        spherical_harmonics.colors(original.sh, directions),
        atol=1e-5,  # float32
        rtol=0,
    )


@pytest.mark.parametrize("axes", ["", "RDFX", "RLF", "xyz"])
def test_axes_that_are_none(axes):
    with pytest.raises(ValueError, match="expected directions of x, y and z"):
        formats.read_scene(TOOLS / "scene.ply", axes=axes)


def test_glb_places_its_mesh_by_its_nodes(original, tmp_path):
    content, binary = format_files.parts_of_glb((TOOLS / "scene.glb").read_bytes())
    turn = [0.0, 0.0, 2**-0.5, 2**-0.5]  # a quarter turn about z
    content["nodes"] = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "rotation": turn, "scale": [2, 2, 2]}]
    (tmp_path / "a.glb").write_bytes(format_files.glb(content, binary))
    found = formats.read_gaussians(tmp_path / "a.glb")
    rotation = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    in_gltf = original.means * torch.tensor([-1.0, -1, 1])
    expected = (2 * in_gltf @ rotation.T + torch.tensor([1.0, 2, 3])) * torch.tensor([-1.0, -1, 1])
    torch.testing.assert_close(found.means, expected, atol=1e-5, rtol=0)  # float32
    torch.testing.assert_close(found.log_scales, original.log_scales + torch.tensor(2.0).log())
    for distorted in ([1, 2, 1], [-1, 1, 1]):
        content["nodes"][1]["scale"] = distorted
        (tmp_path / "a.glb").write_bytes(format_files.glb(content, binary))
        with pytest.raises(ValueError, match=r"a\.glb: expected nodes that rotate and scale uniformly"):
            formats.read_gaussians(tmp_path / "a.glb")


def test_glb_with_quantised_attributes(original, tmp_path):
    content, binary = format_files.parts_of_glb((TOOLS / "scene.glb").read_bytes())
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    unit = torch.nn.functional.normalize(original.quaternions, dim=1)
    rotated = change_axes(replace(original, quaternions=unit), rdf_from("LUF").T)  # back to glTF's axes
    packed = (rotated.quaternions[:, [1, 2, 3, 0]] * 32767).round().to(torch.int16).numpy().tobytes()
    content["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(packed)})
    accessor = {"bufferView": len(content["bufferViews"]) - 1, "componentType": 5122, "normalized": True}
    content["accessors"].append(accessor | {"count": 40, "type": "VEC4"})
    attributes["KHR_gaussian_splatting:ROTATION"] = len(content["accessors"]) - 1
    (tmp_path / "a.glb").write_bytes(format_files.glb(content, binary + packed))
    steps = GLB | {"ellipsoids": 2e-4}  # 16 bits
    assert_within(original, formats.read_gaussians(tmp_path / "a.glb"), steps)
