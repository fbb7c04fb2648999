"""Meshes as scenes: geometry, materials and textures of each format, refused files, and the cover of the surface."""

import io
import json
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from mesh_files import QUAD, cube, glb, picture, textured_quad, write_obj, write_ply, write_stl
from PIL import Image
from test_damaged_files import DERANDOMIZED, FEW, anything, assert_refused

from splatgraft import formats
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import KnownSurface
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.rendering import render

UP = torch.tensor([0.0, -1.0, 0.0])


def read(path, data: bytes | None = None, budget: int = 600) -> KnownSurface:
    if data is not None:
        path.write_bytes(data)
    found = formats.read_scene(path, mesh_budget=budget).gaussians
    assert isinstance(found, KnownSurface)
    return found


def albedo(g: KnownSurface) -> torch.Tensor:
    return linear_from_srgb(rgb_from_dc(g.sh[:, 0]))


def test_glb_with_metallic_roughness_vertex_colors_and_emission(tmp_path):
    surface = picture(np.full((4, 4, 3), (9, 102, 51)))  # green is roughness, blue metallic
    material = {
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.5, 1, 1, 1],
            "metallicFactor": 0.5,
            "metallicRoughnessTexture": {"index": 0},
        },
        "emissiveFactor": [0, 0.25, 0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2}},
    }
    colors = {"COLOR_0": np.full((4, 4), 51, np.uint8)}  # normalised, linear: 0.2
    g = read(tmp_path / "a.glb", textured_quad(material, surface, attributes=colors))
    assert torch.allclose(albedo(g).mean(0), torch.tensor([0.1, 0.2, 0.2]), atol=1e-4)  # float32 and sRGB and back
    assert torch.allclose(g.roughness, torch.tensor(0.4), atol=1e-6)
    assert torch.allclose(g.metallic, torch.tensor(0.1), atol=1e-6)
    assert torch.allclose(g.emission, torch.tensor([0, 0.5, 0]), atol=1e-6)
    # the file's metres, and up in the axes of a .ply
    assert formats.read_scene(tmp_path / "a.glb", mesh_budget=50).metadata.metres_per_unit == 1
    # an open sheet has two sides of 4 square units each
    assert float((g.normals @ UP).abs().min()) > 0.999
    assert float((g.normals @ UP > 0).float().mean()) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
def test_texture_lies_where_its_coordinates_say(tmp_path, kind):
    # left half red, right half blue; a 64 texel image keeps JPEG's blur at the middle
    pixels = np.zeros((64, 64, 3))
    pixels[:, :32, 0], pixels[:, 32:, 2] = 255, 255
    texture = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}
    extra = {}
    if kind == "WEBP":
        extra = {
            "textures": [{"extensions": {"EXT_texture_webp": {"source": 0}}}],
            "extensionsUsed": ["EXT_texture_webp"],
        }
    g = read(tmp_path / "a.glb", textured_quad(texture, picture(pixels, kind), **extra))
    left = -g.means[:, 0] < -0.1  # glTF's x points left, so it is turned in a .ply
    right = -g.means[:, 0] > 0.1
    assert float(albedo(g)[left, 0].min()) > 0.9  # JPEG's quantisation
    assert float(albedo(g)[right, 2].min()) > 0.9
    assert float(albedo(g)[left, 2].max()) < 0.05


def test_texture_transform_of_khronos(tmp_path):
    # a quarter turn counterclockwise with this offset takes (u, v) to (v, 1 - u)
    pixels = np.zeros((64, 64, 3))
    pixels[:, :32, 0], pixels[:, 32:, 2] = 255, 255
    transform = {"offset": [0, 1], "rotation": np.pi / 2}
    texture = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    material = {"pbrMetallicRoughness": {"baseColorTexture": texture, "metallicFactor": 0}}
    g = read(tmp_path / "a.glb", textured_quad(material, picture(pixels), extensionsRequired=["KHR_texture_transform"]))
    # v runs with glTF's z, which a .ply keeps: red at small v
    assert float(albedo(g)[g.means[:, 2] < -0.1, 0].min()) > 0.99
    assert float(albedo(g)[g.means[:, 2] > 0.1, 2].min()) > 0.99


def test_normal_map_bends_towards_its_axes(tmp_path):
    # x of the map along +u, which is glTF's +x, and -x in a .ply: a slope of one half
    pixels = np.full((4, 4, 3), 255 * (0.5 + 0.5 * np.array([1, 0, 2]) / np.sqrt(5)))
    material = {"normalTexture": {"index": 0}}
    g = read(tmp_path / "a.glb", textured_quad(material, picture(pixels)))
    top = g.normals @ UP > 0
    want = torch.tensor([-1.0, -2.0, 0.0]) / 5**0.5
    assert float((g.normals[top] @ want).min()) > 0.9999  # 8 bits: half a degree
    # the same relief, seen from behind
    assert float((g.normals[~top] @ -want).min()) > 0.9999


@pytest.mark.parametrize("scale", [[1, 1, 1], [-1, 1, 1], [2, -1, 0.5]])
def test_a_mirroring_node_leaves_the_normals_outside(tmp_path, scale):
    vertices, faces = cube()
    g = read(tmp_path / "a.glb", glb({"POSITION": vertices}, faces, node={"scale": scale, "translation": [5, 0, 0]}))
    middle = torch.tensor([-5.0, 0, 0])
    assert float(((g.means - middle) * g.normals).sum(1).min()) > 0


def test_an_inverted_cube_and_one_with_degenerate_triangles_are_covered_outside(tmp_path):
    vertices, faces = cube()
    flat = np.array([[0, 0, 1], [2, 2, 2]], np.uint32)
    for name, triangles in (("inverted", faces[:, ::-1]), ("degenerate", np.concatenate([faces, flat]))):
        g = read(tmp_path / f"{name}.glb", glb({"POSITION": vertices}, np.ascontiguousarray(triangles)))
        assert float((g.means * g.normals).sum(1).min()) > 0
        assert g.means.isfinite().all()


def test_points_are_even(tmp_path):
    vertices, faces = cube()
    g = read(write_stl(tmp_path / "a.stl", vertices, faces), budget=6000)
    assert 0.85 * 6000 < g.count <= 6000  # a strip along each edge has no discs
    face = g.means[g.normals[:, 0] > 0.9]
    nearest = torch.cdist(face, face).topk(2, largest=False).values[:, 1]
    spacing = (6 / g.count) ** 0.5
    # Poisson discs have a smallest distance; independent points would have 10% below a fifth of the spacing
    assert float(nearest.quantile(0.01)) > 0.5 * spacing
    # no hole: each point of a face is seen as opaque from outside
    camera = pinhole(look_at(torch.tensor([[0.0, -0.2, -1.3]]), torch.zeros(3), UP), 200.0, width=160, height=160)
    alpha = render(g, camera).alpha[0]
    assert float(alpha[50:110, 50:110].min()) > 0.98


@pytest.mark.parametrize("cells", [1, 120])
def test_a_sheet_has_straight_outlines_and_no_holes_however_finely_it_is_divided(tmp_path, cells):
    x = np.linspace(-1, 1, cells + 1)
    corners = np.stack([*np.meshgrid(x, x), np.zeros((cells + 1, cells + 1))], 2).reshape(-1, 3).astype(np.float32)
    first = np.add.outer((cells + 1) * np.arange(cells), np.arange(cells)).reshape(-1, 1)
    faces = np.concatenate([first + np.array(c) for c in ((0, 1, cells + 2), (0, cells + 2, cells + 1))])
    g = read(write_stl(tmp_path / "a.stl", corners, faces), budget=8000)
    # from above, 290 pixels wide; the spacing of a side is 4.6 pixels
    camera = pinhole(
        look_at(torch.tensor([[0.0, -4.0, 0.0]]), torch.zeros(3), torch.eye(3)[2]), 580.0, width=400, height=400
    )
    alpha = render(g, camera).alpha[0]
    outline = (alpha[:200] > 0.5).float().argmax(0)[85:315].float()
    assert float(outline.std()) < 0.1 * 4.6 + 0.3  # and the pixels' own rounding
    assert abs(float(outline.mean()) - 55) < 0.5 * 4.6
    one_side = render(g.select(g.normals @ UP > 0), camera).alpha[0]
    assert float(one_side[70:330, 70:330].min()) > 0.8
    assert float(one_side[70:330, 70:330].mean()) > 0.985


@pytest.mark.parametrize("thickness", [1e-3, 0.02])
def test_the_two_faces_of_a_thin_board_do_not_change_sides(tmp_path, thickness):
    vertices, faces = cube()
    g = read(write_stl(tmp_path / "a.stl", vertices * np.float32([1, 1, thickness]), faces), budget=2000)
    # z of the file is up
    up = -g.normals[:, 1]
    assert float((-g.means[:, 1] * up)[up.abs() > 0.9].min()) > 0


def test_the_sides_of_a_sheet_do_not_show_through_each_other(tmp_path):
    g = read(tmp_path / "a.glb", textured_quad({}), budget=4000)
    is_top = (g.normals @ UP > 0).float()
    marked = replace(g, sh=dc_from_rgb(is_top[:, None, None].expand(-1, 1, 3).contiguous()))
    camera = pinhole(look_at(torch.tensor([[0.0, -2.0, -2.0]]), torch.zeros(3), UP), 150.0, width=120, height=90)
    drawn = render(marked, camera)
    # 45 degrees above the sheet
    assert float(drawn.color[0][..., 0][drawn.alpha[0] > 0.95].mean()) > 0.9


def test_obj_with_materials_and_texture(tmp_path):
    path = write_obj(tmp_path)
    g = read(path)
    red, green = (albedo(g)[:, i] > 0.9 for i in (0, 1))
    assert bool((red ^ green).all())
    # the red triangle is below the diagonal; y of the file is up
    assert bool((-g.means[red, 1] < -g.means[red, 0] + 0.1).all())
    (tmp_path / "green.png").unlink()
    assert any("green.png" in sentence for sentence in formats.read_scene(path, mesh_budget=50).said())


def test_ply_with_vertex_colors_and_stl_stand_on_z(tmp_path):
    vertices, faces = cube()
    vertices = vertices * np.float32([1, 1, 2])
    for path in (write_ply(tmp_path / "a.ply", vertices, faces), write_stl(tmp_path / "a.stl", vertices, faces)):
        g = read(path)
        assert float(g.means[:, 1].max() - g.means[:, 1].min()) > 1.7
    assert float(albedo(read(tmp_path / "a.ply"))[:, 0].min()) > 0.99


def test_a_ply_keeps_the_known_surface(tmp_path):
    vertices, faces = cube()
    g = read(write_stl(tmp_path / "a.stl", vertices, faces))
    turn = Similarity(2.0, torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), torch.ones(3))
    moved = turn.gaussians(g)
    formats.write_gaussians(tmp_path / "b.ply", moved)
    found = formats.read_gaussians(tmp_path / "b.ply")
    assert isinstance(found, KnownSurface)
    for name in ("means", "sh", "metallic", "roughness", "emission"):
        assert torch.equal(getattr(found, name), getattr(moved, name))
    assert float((found.normals * moved.normals).sum(1).min()) > 0.99999  # normalised again
    assert float(((moved.means - 1) * moved.normals).sum(1).min()) > 0
    assert formats.has_known_surface(tmp_path / "b.ply")
    assert formats.has_known_surface(tmp_path / "a.stl")


DRACO = ["KHR_draco_mesh_compression"]
REFUSED = {
    "draco": ({"extensionsRequired": DRACO, "extensionsUsed": DRACO}, "draco"),
    "unknown": ({"extensionsRequired": ["EXT_other"]}, "EXT_other"),
    "skin": ({"node": {"skin": 0}}, "skin"),
    "cycle": ({"nodes": [{"children": [0]}]}, "without cycles"),
    "no triangles": ({"primitive": {"mode": 0}}, "without triangles"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_is_named_in_one_line(tmp_path, name):
    content, said = REFUSED[name]
    with pytest.raises(ValueError, match=said) as error:
        read(tmp_path / "a.glb", glb({"POSITION": QUAD}, np.array([[0, 2, 1]], np.uint16), **content))
    assert str(tmp_path / "a.glb") in str(error.value)
    assert "\n" not in str(error.value)


def test_glass_is_said_to_be_opaque(tmp_path):
    data = glb({"POSITION": QUAD}, np.array([[0, 2, 1]], np.uint16), extensionsUsed=["KHR_materials_transmission"])
    (tmp_path / "a.glb").write_bytes(data)
    assert any("opaque" in sentence for sentence in formats.read_scene(tmp_path / "a.glb", mesh_budget=50).said())


def test_files_outside_of_the_folder_are_not_read(tmp_path):
    (tmp_path / "secret.bin").write_bytes(bytes(48))
    (tmp_path / "in").mkdir()
    content = {"asset": {"version": "2.0"}, "buffers": [{"uri": "../secret.bin", "byteLength": 48}], "meshes": []}
    (tmp_path / "in" / "a.gltf").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="in the folder of the glTF"):
        formats.read_scene(tmp_path / "in" / "a.gltf")
    obj = write_obj(tmp_path / "in")
    (tmp_path / "in" / "two.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl printed\nmap_Kd ../green.png\n")
    (tmp_path / "green.png").write_bytes(picture(np.full((4, 4, 3), (0, 255, 0))))
    assert any("green.png" in sentence for sentence in formats.read_scene(obj, mesh_budget=50).said())


def test_a_huge_stride_of_zero_takes_no_memory(tmp_path):
    data = glb({"POSITION": QUAD}, np.array([[0, 2, 1]], np.uint16))
    length = struct.unpack_from("<I", data, 12)[0]
    content = json.loads(data[20 : 20 + length])
    content["bufferViews"][0]["byteStride"] = 0
    content["accessors"][0]["count"] = 10**10
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    with pytest.raises(ValueError, match="byteStride"):
        read(tmp_path / "a.glb", data[:12] + struct.pack("<2I", len(text), 0x4E4F534A) + text + data[20 + length :])


def test_a_texture_of_too_many_pixels_is_refused(tmp_path):
    stream = io.BytesIO()
    Image.new("1", (9000, 9000)).save(stream, "PNG")
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    with pytest.raises(ValueError, match="found 9000 x 9000"):
        read(tmp_path / "a.glb", textured_quad(material, stream.getvalue()))


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    vertices, faces = cube()
    write_obj(folder)
    write_stl(folder / "a.stl", vertices, faces)
    write_ply(folder / "a.ply", vertices, faces)
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    (folder / "a.glb").write_bytes(textured_quad(material, picture(np.zeros((4, 4, 3)))))
    return folder


@pytest.mark.parametrize("name", ["a.glb", "two.obj", "two.mtl", "a.stl", "a.ply"])
@given(damage=anything)
@settings(max_examples=FEW, **DERANDOMIZED)
def test_damaged(seeds, name, damage):
    whole = (seeds / name).read_bytes()
    (seeds / name).write_bytes(damage(whole))
    tracemalloc.start()
    try:
        formats.read_scene(seeds / ("two.obj" if name == "two.mtl" else name), mesh_budget=50)
    except ValueError as error:
        assert_refused(str(error), seeds)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        (seeds / name).write_bytes(whole)
    assert peak < 64 << 20  # trimesh itself takes 20 MB when it is first imported
