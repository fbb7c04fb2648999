"""Triangle meshes of .obj (with its .mtl and textures), .stl and .ply files, by trimesh."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core.images import linear_from_srgb
from splatgraft.core.meshes import MAX_TRIANGLES, Mesh, MeshMaterial, Texture, concatenate, make_mesh
from splatgraft.formats.gltf import read_uri
from splatgraft.formats.meshes.gltf_mesh import texture_pixels
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.axes import rdf_from

AXES = {".obj": "LUF", ".stl": "RFU", ".ply": "RFU"}
"""Usual axes by suffix: .obj has y up, files for printing and scanning have z up."""
_MAX_BYTES = 2 << 30
_BYTES_PER_TRIANGLE = 6  # fewest, of an .obj's `f 1 2 3`, with a reserve


def is_polygon_ply(path: Path) -> bool:
    """Whether a .ply has faces and no opacities, which Gaussians have."""
    header = ply.read_header(path)
    face, vertex = header.element("face"), header.element("vertex")
    return face is not None and face.count > 0 and vertex is not None and "opacity" not in vertex.types


def read_polygons(path: Path) -> tuple[Mesh, tuple[str, ...]]:
    """Read a mesh in the axes RDF; returns notes for the user as well."""
    import trimesh

    if (size := path.stat().st_size) > _MAX_BYTES:
        raise ValueError(f"expected at most {_MAX_BYTES >> 30} GiB, found {size / 2**30:.1f} GiB")
    suffix = path.suffix.lower()
    beside: Any = _Beside(path)  # trimesh's own resolver would read files anywhere
    with path.open("rb") as stream:
        scene = trimesh.load_scene(stream, file_type=suffix[1:], resolver=beside, process=False)
    found = [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    count = sum(len(mesh.faces) for mesh in found)
    if not 0 < count <= MAX_TRIANGLES or count > size / _BYTES_PER_TRIANGLE:
        raise ValueError(f"expected 1 to {MAX_TRIANGLES:,} triangles, found {count:,}")
    turn = rdf_from(AXES[suffix]).numpy()
    joined = concatenate([_part(mesh, turn) for mesh in found])
    missing = f"not found beside it: {', '.join(beside.missing[:4])}; what they colour is white"
    return joined, (missing,) if beside.missing else ()


class _Beside:
    """Files in the folder of a mesh, as trimesh asks for them."""

    def __init__(self, path: Path) -> None:
        self._path, self.missing = path, list[str]()

    def get(self, name: str) -> bytes:
        """Read a file; one that is missing or elsewhere is remembered."""
        try:
            return read_uri(self._path, name.strip().replace("\\", "/"))
        except ValueError as error:
            self.missing.append(name[:60])
            raise FileNotFoundError(name) from error

    __getitem__ = get


def _part(mesh: Any, turn: Float[np.ndarray, "3 3"]) -> Mesh:
    """Convert a mesh of trimesh's."""
    visual, normals, uv, colors, texture = mesh.visual, None, None, None, None
    if "vertex_normals" in mesh._cache:  # those of the file; without any, trimesh would smooth edges away
        normals = np.asarray(mesh.vertex_normals, np.float64) @ turn.T
    material = MeshMaterial()
    if visual.kind == "vertex":
        srgb = torch.from_numpy(np.asarray(visual.vertex_colors)[:, :3] / np.float32(255))
        colors = linear_from_srgb(srgb).numpy()
    elif visual.kind == "texture":
        image = getattr(visual.material, "image", None)
        if image is not None and visual.uv is not None and len(visual.uv) == len(mesh.vertices):
            uv = (np.asarray(visual.uv, np.float32) * (1, -1) + (0, 1)).astype(np.float32)
            texture = Texture(texture_pixels(image))
        pbr = visual.material.to_pbr()
        rgba = [255] * 4 if pbr.baseColorFactor is None else pbr.baseColorFactor
        r, g, b = linear_from_srgb(torch.tensor(rgba[:3]) / 255).tolist()
        roughness = 1.0 if pbr.roughnessFactor is None else float(pbr.roughnessFactor)
        material = MeshMaterial((r, g, b, 1.0), roughness=roughness, color_map=texture)
    positions = np.asarray(mesh.vertices, np.float64) @ turn.T
    return make_mesh(positions, np.asarray(mesh.faces), material=material, normals=normals, uv=uv, colors=colors)
