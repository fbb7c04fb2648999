"""Exact changes of a scene's axes: signed permutations, named by the directions of x, y and z.

Names follow the .spz library: L or R, D or U, B or F for each of x, y, z. A .ply of the original code has RDF, the axes
of structure from motion.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata

_DIRECTIONS = {"L": (-1, 0, 0), "R": (1, 0, 0), "U": (0, -1, 0), "D": (0, 1, 0), "B": (0, 0, -1), "F": (0, 0, 1)}
"""Unit directions in the axes RDF, by letter."""


def rdf_from(name: str) -> Float[Tensor, "3 3"]:
    """Return the matrix from the axes `name`, such as RUB, to RDF; a reflection for left-handed axes."""
    return torch.tensor([_DIRECTIONS[letter] for letter in name], dtype=torch.float32).T


def change_axes(gaussians: Gaussians, matrix: Float[Tensor, "3 3"]) -> Gaussians:
    """Change the axes of a scene; `matrix` is a signed permutation, new from old, of determinant 1 or -1."""
    g = gaussians
    permutation = matrix.abs()
    # matrix @ R @ matrix.T is a rotation whose axis is transformed as a pseudovector; it acts on permuted own axes
    axis = torch.linalg.det(matrix).round() * (g.quaternions[:, 1:] @ matrix.T)
    harmonics = spherical_harmonics.rotation_matrix(matrix, g.sh_degree)
    if torch.equal(permutation, torch.eye(3)):
        harmonics = harmonics.round()  # each basis function is even or odd under reflections in the axes
    if isinstance(g, KnownSurface):
        g = replace(g, normals=g.normals @ matrix.T)
    return replace(
        g,
        means=g.means @ matrix.T,
        log_scales=g.log_scales @ permutation.T,
        quaternions=torch.cat([g.quaternions[:, :1], axis], 1),
        sh=torch.einsum("jk,nkc->njc", harmonics.to(g.sh), g.sh),
    )


def turn_up(metadata: SceneMetadata, matrix: Float[Tensor, "3 3"]) -> SceneMetadata:
    """Change the axes of the metadata; `matrix` as for `change_axes`."""
    if metadata.up is None:
        return metadata
    x, y, z = (matrix @ torch.tensor(metadata.up)).tolist()
    return replace(metadata, up=(x, y, z))


def with_axes(scene: SceneFile, axes: str) -> SceneFile:
    """Read the file's axes as `axes` instead of the format's."""
    name = axes.upper()
    if len(name) != 3 or any(sum(letter in pair for letter in name) != 1 for pair in ("LR", "UD", "BF")):
        raise ValueError(f"axes: expected directions of x, y and z such as RDF, RUB or LUF, found {axes[:20]!r}")
    if name == scene.axes:
        return scene
    matrix = rdf_from(name) @ rdf_from(scene.axes).T
    gaussians, metadata = change_axes(scene.gaussians, matrix), turn_up(scene.metadata, matrix)
    return replace(scene, gaussians=gaussians, axes=name, metadata=metadata)
