"""Triangle meshes as scenes: their surface is covered by Gaussians of known normals and materials."""

from pathlib import Path

from splatgraft.core.mesh_sampling import sample_mesh
from splatgraft.core.meshes import Mesh
from splatgraft.formats import gltf
from splatgraft.formats.meshes.gltf_mesh import read_gltf_mesh
from splatgraft.formats.meshes.polygon_files import AXES, is_polygon_ply, read_polygons
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.gaussian_glb import has_gaussians, read_gaussian_glb
from splatgraft.formats.scenes.gaussian_ply import SURFACE, read_gaussian_ply
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata

_UP = (0.0, -1.0, 0.0)  # of a mesh, in the axes RDF


def read_ply(path: Path, budget: int) -> SceneFile:
    """Read a .ply of Gaussians, or of a mesh with at most `budget` Gaussians."""
    return read_polygon_file(path, budget) if is_polygon_ply(path) else read_gaussian_ply(path)


def read_gltf(path: Path, budget: int) -> SceneFile:
    """Read a .glb or .gltf of Gaussians, or of a mesh with at most `budget` Gaussians."""
    found = gltf.read_gltf(path)
    if has_gaussians(found):
        return read_gaussian_glb(found)
    mesh, notes = read_gltf_mesh(found, path)
    return _covered(mesh, budget, gltf.AXES, SceneMetadata(_UP, 1.0), notes)  # glTF's unit is the metre


def read_polygon_file(path: Path, budget: int) -> SceneFile:
    """Read a mesh of an .obj, .stl or .ply with at most `budget` Gaussians."""
    mesh, notes = read_polygons(path)
    return _covered(mesh, budget, AXES[path.suffix.lower()], SceneMetadata(_UP), notes)


def has_known_surface(path: Path) -> bool:
    """Whether a scene's file is a mesh, or a .ply of Gaussians whose normals and materials are known."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        vertex = ply.read_header(path).element("vertex")
        return is_polygon_ply(path) or (vertex is not None and set(SURFACE) <= set(vertex.types))
    return suffix in (".obj", ".stl") or (suffix in (".glb", ".gltf") and not has_gaussians(gltf.read_gltf(path)))


def _covered(mesh: Mesh, budget: int, axes: str, metadata: SceneMetadata, notes: tuple[str, ...]) -> SceneFile:
    said = f"a mesh of {len(mesh.corners):,} triangles, covered by Gaussians"
    return SceneFile(sample_mesh(mesh, budget=budget), axes, metadata, (said, *notes))
