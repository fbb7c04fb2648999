"""Files of GS-IR, GaussianShader and 3DGS-DR, with the properties and the order that their public code writes."""

import numpy as np
import pytest
import torch

from splatgraft import formats
from splatgraft.core import spherical_harmonics
from splatgraft.core.spherical_harmonics import basis

COUNT = 120
POSITIONS, NORMALS = ["x", "y", "z"], ["nx", "ny", "nz"]
DC = [f"f_dc_{i}" for i in range(3)]
SHAPE = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def rest(count):
    return [f"f_rest_{i}" for i in range(count)]


GS_IR = [*POSITIONS, *DC, *rest(45), "opacity", *(f"normal_{i}" for i in range(3)),
         *(f"albedo_{i}" for i in range(3)), "roughness", "metallic", *SHAPE]  # fmt: skip
THREE_DGS_DR = [*POSITIONS, *NORMALS, *DC, *rest(45), "opacity", "refl", *SHAPE]


def gaussian_shader(residuals):
    shading = ["roughness", *(f"specular{i}" for i in range(3))]
    return [*POSITIONS, *NORMALS, "nx2", "ny2", "nz2", *DC, *rest(residuals), "opacity", *SHAPE, *shading]


def write(path, names, **given):
    """A file of random numbers, but for the columns given."""
    generator = np.random.default_rng(3)
    table = np.zeros(COUNT, [(name, "<f4") for name in names])
    for name in names:
        table[name] = given.get(name, generator.normal(size=COUNT))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"]
    header += [f"property float {name}" for name in names]
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + table.tobytes())
    return table


def columns(table, names):
    return torch.from_numpy(np.stack([table[name] for name in names], 1))


def colors(gaussians, directions):
    """Colours (n d 3) of all Gaussians from all directions, as 3DGS shades them, before it clamps."""
    values = basis(directions, gaussians.sh_degree)
    return 0.5 + torch.einsum("dk,nkc->ndc", values, gaussians.sh)


@pytest.fixture(scope="module")
def directions():
    return torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=1)


@pytest.mark.parametrize("names", [GS_IR, THREE_DGS_DR])
def test_what_is_3dgs_in_them_is_read_as_it_is(tmp_path, names):
    table = write(tmp_path / "a.ply", names)
    found = formats.read_gaussians(tmp_path / "a.ply")
    assert torch.equal(found.means, columns(table, POSITIONS))
    assert torch.equal(found.sh[:, 0], columns(table, DC))
    assert torch.equal(found.sh[:, 1:].transpose(1, 2).flatten(1), columns(table, rest(45)))
    assert torch.equal(found.opacity_logits, torch.from_numpy(table["opacity"].copy()))


def test_gs_irs_material_and_light_are_said_to_be_left_out(tmp_path):
    write(tmp_path / "a.ply", GS_IR)
    (note,) = formats.read_scene(tmp_path / "a.ply").notes
    assert note.startswith("GS-IR: colours are its SH")
    assert "albedo_0" in note


def test_3dgs_drs_reflections_are_said_to_be_left_out_with_their_share(tmp_path):
    logits = np.where(np.arange(COUNT) < 30, 1.0, -5.0)
    write(tmp_path / "a.ply", THREE_DGS_DR, refl=logits)
    (note,) = formats.read_scene(tmp_path / "a.ply").notes
    assert "(.map), are left out: 25% of the Gaussians reflect by more than 0.1" in note


@pytest.mark.parametrize("degree", [None, 1, 2, 3])
def test_gaussian_shaders_colours_are_its_diffuse_part_and_residual(tmp_path, directions, degree):
    """Its shader adds the SH of f_rest, from band 0 on, to sigmoid(f_dc - ln 3); f_dc is no SH."""
    count = 0 if degree is None else spherical_harmonics.coefficient_count(degree)
    table = write(tmp_path / "a.ply", gaussian_shader(3 * count))
    scene = formats.read_scene(tmp_path / "a.ply")
    diffuse = 1 / (1 + 3 * torch.exp(-columns(table, DC)))
    wanted = diffuse[:, None].expand(-1, len(directions), -1)
    if degree is not None:
        residual = columns(table, rest(3 * count)).reshape(COUNT, count, 3)
        wanted = wanted + torch.einsum("dk,nkc->ndc", basis(directions, degree), residual)
    # float32 sums of at most 17 terms of up to 5
    torch.testing.assert_close(colors(scene.gaussians, directions), wanted, atol=2e-5, rtol=0)
    (note,) = scene.notes
    assert note.startswith("GaussianShader: colours are its diffuse part")
    assert "specular0" in note


def test_a_number_of_residuals_of_no_degree_is_one_line(tmp_path):
    write(tmp_path / "a.ply", gaussian_shader(45))
    with pytest.raises(ValueError, match=r"expected 0, 12, 27, 48 or 75 properties f_rest_0 .*, found 45"):
        formats.read_gaussians(tmp_path / "a.ply")


def test_unknown_properties_are_named_as_not_used(tmp_path):
    plain = [*POSITIONS, *NORMALS, *DC, "opacity", *SHAPE]
    write(tmp_path / "a.ply", plain)
    assert formats.read_scene(tmp_path / "a.ply").notes == ()
    write(tmp_path / "a.ply", [*plain, *(f"semantic_{i}" for i in range(8))])
    (note,) = formats.read_scene(tmp_path / "a.ply").notes
    assert note == "not used: the properties " + ", ".join(f"semantic_{i}" for i in range(6)) + " and 2 more"
