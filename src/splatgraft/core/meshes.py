"""The value `Mesh`: textured triangles with metallic-roughness materials, as in glTF 2.0."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

Wrap = Literal["repeat", "mirror", "clamp"]


@dataclass(frozen=True)
class Texture:
    """An image on a surface."""

    pixels: UInt8[np.ndarray, "h w 4"]
    """Red, green, blue, alpha; row 0 is at v = 0."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Continuation of the image outside [0, 1], along u and v."""
    image_from_uv: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1, 0, 0), (0, 1, 0))
    """Affine map of texture coordinates."""


@dataclass(frozen=True)
class MeshMaterial:
    """A metallic-roughness material; maps are multiplied with the numbers of the same name."""

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
    """Normals in tangent space: x along u, y against v of the image."""
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


MAX_TRIANGLES = 4_000_000
"""Largest number of triangles that is read; they take 600 MB."""


def flat_normals(corners: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3 3"]:
    """Compute the normals of the triangles' planes at each corner; 0 for a triangle without area."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.repeat(unit(across)[:, None], 3, 1)


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Normalise vectors; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
