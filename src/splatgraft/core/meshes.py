"""The value `Mesh`: textured triangles with metallic-roughness materials, as in glTF 2.0."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

MAX_TRIANGLES = 4_000_000
"""Largest number of triangles that is read; they take 600 MB."""
Wrap = Literal["repeat", "mirror", "clamp"]


@dataclass(frozen=True)
class Texture:
    """An image on a surface."""

    pixels: UInt8[np.ndarray, "h w 4"]
    """Red, green, blue, alpha; row 0 is at v = 0."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Continuation of the image outside [0, 1], along u and v."""
    image_from_uv: Float[np.ndarray, "2 3"] = field(default_factory=lambda: np.eye(2, 3))
    """Affine map of texture coordinates."""


@dataclass(frozen=True, eq=False)
class MeshMaterial:
    """A metallic-roughness material; maps are multiplied with the numbers of the same name, None is white."""

    color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Base colour, linear rgb, and alpha."""
    metallic: float = 0.0
    """Share of metal, in [0, 1]."""
    roughness: float = 1.0
    """Perceptual roughness, in [0, 1]; its square is GGX's alpha."""
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Emitted linear rgb; white is 1."""
    alpha_cutoff: float = 0.0
    """Alpha below which the surface has a hole."""
    normal_scale: float = 1.0
    """Factor on x and y of `normal_map`."""
    color_map: Texture | None = None
    """Base colour, sRGB, with alpha."""
    surface_map: Texture | None = None
    """Roughness in green and metallic in blue, linear."""
    normal_map: Texture | None = None
    """Normals in tangent space: x along u, y against v of the image; None for no relief."""
    emission_map: Texture | None = None
    """Emission, sRGB."""


@dataclass(frozen=True)
class Mesh:
    """t triangles, in the axes RDF, seen counterclockwise from their front."""

    corners: Float[np.ndarray, "t 3 3"]
    """Positions."""
    normals: Float[np.ndarray, "t 3 3"]
    """Unit normals at the corners."""
    uv: Float[np.ndarray, "t 3 2"]
    """Texture coordinates, v downwards; 0 without any."""
    colors: Float[np.ndarray, "t 3 3"]
    """Linear rgb factors on the base colour."""
    material: Int[np.ndarray, "t"]
    """Position of each triangle's material in `materials`."""
    materials: tuple[MeshMaterial, ...]


def make_mesh(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    *,
    material: MeshMaterial,
    normals: Float[np.ndarray, "v 3"] | None = None,
    uv: Float[np.ndarray, "v 2"] | None = None,
    colors: Float[np.ndarray, "v 3"] | None = None,
) -> Mesh:
    """Make a mesh of one material from the values of its v vertices.

    Normals may have any length; None or 0 stands for those of the triangles' planes.

    Raises:
        ValueError: A value is not finite.
    """
    normals = np.zeros_like(positions) if normals is None else normals
    uv = np.zeros((len(positions), 2), np.float32) if uv is None else uv
    colors = np.ones(positions.shape, np.float32) if colors is None else colors
    corners, given, uv, colors = (values[faces] for values in (positions, normals, uv, colors))
    if not all(np.isfinite(values).all() for values in (corners, given, uv, colors)):
        raise ValueError("expected finite positions, normals, texture coordinates and colours, found others")
    flat = unit(area_vectors(corners))[:, None]
    normals = np.where((given != 0).any(-1, keepdims=True), unit(given), flat)
    return Mesh(corners, normals, uv, colors, np.zeros(len(faces), np.int64), (material,))


def concatenate(parts: Sequence[Mesh]) -> Mesh:
    """Join meshes; a material that several parts share appears once."""
    materials = list(dict.fromkeys(material for part in parts for material in part.materials))
    material = [np.array([materials.index(one) for one in part.materials])[part.material] for part in parts]
    names = ("corners", "normals", "uv", "colors")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Mesh(**joined, material=np.concatenate(material), materials=tuple(materials))


def area_vectors(corners: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3"]:
    """Compute the normals of the triangles' planes times twice the areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def unit(vectors: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n k"]:
    """Normalise vectors; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
