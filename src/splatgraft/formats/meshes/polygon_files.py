"""Triangle meshes of .obj (with its .mtl and textures), .stl and .ply files, by trimesh."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from splatgraft.core.images import linear_from_srgb
from splatgraft.core.meshes import MAX_TRIANGLES, Mesh, MeshMaterial, Texture, flat_normals, unit
from splatgraft.formats.gltf import read_uri
from splatgraft.formats.meshes.gltf_mesh import decode_image
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
    parts, materials = zip(*(_part(mesh, turn) for mesh in found), strict=True)
    joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    if not all(np.isfinite(values).all() for values in joined):
        raise ValueError("expected finite positions, normals and colours, found others")
    corners, normals, uv, colors = joined
    which = np.repeat(np.arange(len(found)), [len(mesh.faces) for mesh in found])
    missing = f"not found beside it: {', '.join(beside.missing[:4])}; what they colour is white"
    return Mesh(corners, normals, uv, colors, which, materials), (missing,) if beside.missing else ()


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

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)


def _part(mesh: Any, turn: Float[np.ndarray, "3 3"]) -> tuple[tuple[np.ndarray, ...], MeshMaterial]:
    """Return corners, normals, texture coordinates and vertex colours of one part, and its material."""
    faces: Int[np.ndarray, "t 3"] = np.asarray(mesh.faces)
    corners = np.asarray(mesh.vertices, np.float64)[faces] @ turn.T
    normals = flat_normals(corners)
    if "vertex_normals" in mesh._cache:  # those of the file; without any, trimesh would smooth edges away
        given = unit(np.asarray(mesh.vertex_normals, np.float64) @ turn.T)[faces]
        normals = np.where((given != 0).any(-1, keepdims=True), given, normals)
    uv, colors = np.zeros((*faces.shape, 2), np.float32), np.ones(corners.shape, np.float32)
    if mesh.visual.kind == "vertex":
        srgb = torch.from_numpy(np.asarray(mesh.visual.vertex_colors)[faces][..., :3] / np.float32(255))
        return (corners, normals, uv, linear_from_srgb(srgb).numpy()), MeshMaterial()
    if mesh.visual.kind != "texture":
        return (corners, normals, uv, colors), MeshMaterial()
    given, image = mesh.visual.uv, getattr(mesh.visual.material, "image", None)
    texture = None
    if given is not None and len(given) == len(mesh.vertices) and image is not None:
        uv = (np.asarray(given, np.float32) * (1, -1) + (0, 1))[faces].astype(np.float32)
        buffer = io.BytesIO()
        image.convert("RGBA").save(buffer, "PNG")
        texture = Texture(decode_image(buffer.getvalue()))
    material = mesh.visual.material.to_pbr()
    rgba = [255] * 4 if material.baseColorFactor is None else material.baseColorFactor
    r, g, b = linear_from_srgb(torch.tensor(rgba[:3]) / 255).tolist()
    roughness = 1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
    return (corners, normals, uv, colors), MeshMaterial((r, g, b, 1.0), roughness=roughness, color_map=texture)
