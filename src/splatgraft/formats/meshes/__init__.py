"""Triangle meshes as scenes: their surface is covered by Gaussians of known normals and materials."""

from pathlib import Path

from splatgraft.core.mesh_sampling import sample_mesh
from splatgraft.formats import gltf
from splatgraft.formats.meshes.gltf_mesh import read_gltf_mesh
from splatgraft.formats.meshes.polygon_files import AXES, is_polygon_ply, read_polygons
from splatgraft.formats.parsing import parsing
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.gaussian_glb import has_gaussians, read_gaussian_glb
from splatgraft.formats.scenes.gaussian_ply import SURFACE, read_gaussian_ply
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata

SUFFIXES = (".ply", ".glb", ".gltf", ".obj", ".stl")
"""Suffixes of meshes; a .ply or .glb may hold Gaussians instead."""
_GLTF = (".glb", ".gltf")
_UP = (0.0, -1.0, 0.0)  # of a mesh, in the axes RDF


def read_surface(path: Path, budget: int) -> SceneFile:
    """Read a mesh with at most `budget` Gaussians, or the Gaussians of a .ply or .glb."""
    suffix = path.suffix.lower()
    if suffix in _GLTF:
        found = gltf.read_gltf(path)
        if has_gaussians(found):
            return read_gaussian_glb(found)
        (mesh, notes), axes, metadata = read_gltf_mesh(found, path), gltf.AXES, SceneMetadata(_UP, 1.0)  # in metres
    elif suffix == ".ply" and not is_polygon_ply(path):
        return read_gaussian_ply(path)
    else:
        (mesh, notes), axes, metadata = read_polygons(path), AXES[suffix], SceneMetadata(_UP)
    said = f"a mesh of {len(mesh.corners):,} triangles, covered by Gaussians"
    return SceneFile(sample_mesh(mesh, budget=budget), axes, metadata, (said, *notes))


def has_known_surface(path: Path) -> bool:
    """Whether a scene's file is a mesh, or Gaussians whose normals and materials are known."""
    with parsing(path):
        suffix = path.suffix.lower() if path.is_file() else ""
        if suffix == ".ply":
            vertex = ply.read_header(path).element("vertex")
            return is_polygon_ply(path) or (vertex is not None and set(SURFACE) <= set(vertex.types))
        return suffix in SUFFIXES and not (suffix in _GLTF and has_gaussians(gltf.read_gltf(path)))
