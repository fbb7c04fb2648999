"""Reads binary glTF with KHR_gaussian_splatting (ratified 2026), also in its .spz compression.

Attributes of a POINTS primitive: ROTATION (xyzw), SCALE (linear), OPACITY (linear), SH_DEGREE_l_COEF_n. Transforms of
nodes are applied. glTF's axes are left-up-front; they are turned to those of a .ply.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.formats.json_file import excerpt
from splatgraft.formats.scenes.axes import change_axes, rdf_from
from splatgraft.formats.scenes.glb_container import Glb, read_glb
from splatgraft.formats.scenes.quantized import logits_from_unit
from splatgraft.formats.scenes.scene_file import SceneFile
from splatgraft.formats.scenes.spz import decode_spz

SPLATTING = "KHR_gaussian_splatting"
"""The extension's name, which stands before those of its attributes as well."""
_COMPRESSIONS = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
GLTF_AXES = "LUF"
"""Left, up, front."""
_SMALLEST_SCALE = 1e-30
"""World units; replaces a scale of exactly 0, since the logarithm is stored."""
_RIGID = 1e-3
"""Largest deviation of a node's matrix from a uniformly scaled rotation, over its scale."""
_MOST_COPIES = 16
"""Gaussians over bytes of the file, at the size of one that is quantised: a mesh may be placed several times."""


def read_gaussian_glb(path: Path) -> SceneFile:
    """The Gaussians of all primitives, placed by their nodes.

    Raises: ValueError where the file is damaged or has no Gaussians, or a node distorts them.
    """
    glb = read_glb(path)
    notes: list[str] = []
    parts: list[Gaussians] = []
    for mesh, matrix in glb.nodes_with_meshes():
        for primitive in _splats(glb, mesh):
            part, said = _gaussians(glb, primitive)
            notes += [note for note in said if note not in notes]
            parts.append(_placed(path, part, matrix))
            if sum(part.count for part in parts) > _MOST_COPIES * max(1000, len(glb.binary) // 20):
                raise ValueError(f"{path}: expected Gaussians that are stored about once, found many copies")
    if not parts:
        raise ValueError(f"{path}: expected Gaussians ({SPLATTING}), found a .glb without")
    gaussians = change_axes(concatenate(parts), rdf_from(GLTF_AXES))
    return SceneFile(gaussians, GLTF_AXES, notes=tuple(notes))


def _splats(glb: Glb, mesh: dict[str, Any]) -> list[dict[str, Any]]:
    primitives = mesh.get("primitives")
    found = []
    for primitive in primitives if isinstance(primitives, list) else []:
        extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
        if isinstance(extensions, dict) and isinstance(extensions.get(SPLATTING), dict):
            found.append(primitive)
    return found


def _gaussians(glb: Glb, primitive: dict[str, Any]) -> tuple[Gaussians, tuple[str, ...]]:
    """One primitive in glTF's axes, and what is said of it."""
    extension = primitive["extensions"][SPLATTING]
    kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", "srgb_rec709_display")
    if kernel != "ellipse":
        raise ValueError(f"{glb.path}: expected the kernel 'ellipse', found {excerpt(kernel)}")
    notes = () if space == "srgb_rec709_display" else (f"its colours are {excerpt(space)}, and are taken for sRGB",)
    compressions = extension.get("extensions")
    for name in _COMPRESSIONS:
        if isinstance(compressions, dict) and isinstance(compressions.get(name), dict):
            data, _ = glb.view(compressions[name].get("bufferView"))
            gaussians, _, said = decode_spz(glb.path, data)
            return gaussians, (*notes, *said)
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise ValueError(f"{glb.path}: expected attributes of the Gaussians, found {excerpt(attributes)}")
    means = _attribute(glb, attributes, "POSITION", "VEC3")
    rotations = _attribute(glb, attributes, f"{SPLATTING}:ROTATION", "VEC4")
    scales = _attribute(glb, attributes, f"{SPLATTING}:SCALE", "VEC3")
    opacities = _attribute(glb, attributes, f"{SPLATTING}:OPACITY", "SCALAR")
    sh = _harmonics(glb, attributes)
    if len({len(values) for values in (means, rotations, scales, opacities, sh)}) > 1:
        raise ValueError(f"{glb.path}: expected as many values of each attribute, found different numbers")
    if bool((scales < 0).any()):
        log_scales = scales
        notes = (*notes, "its scales are negative, thus logarithms, as before the extension was ratified")
    else:
        log_scales = np.log(np.maximum(scales, _SMALLEST_SCALE))
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        log_scales=torch.from_numpy(log_scales),
        quaternions=torch.from_numpy(np.ascontiguousarray(rotations[:, [3, 0, 1, 2]])),
        opacity_logits=logits_from_unit(torch.from_numpy(opacities[:, 0].copy())),
        sh=torch.from_numpy(sh),
    )
    return gaussians, notes


def _attribute(glb: Glb, attributes: dict[str, Any], name: str, kind: str) -> Float[np.ndarray, "n c"]:
    if name not in attributes:
        raise ValueError(f"{glb.path}: expected the attribute {name}, found {excerpt(sorted(attributes))}")
    return glb.values(attributes[name], kind)


def _harmonics(glb: Glb, attributes: dict[str, Any]) -> Float[np.ndarray, "n k 3"]:
    """All bands that are there, from 0 up."""
    coefficients = []
    for degree in range(spherical_harmonics.MAX_DEGREE + 1):
        names = [f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{i}" for i in range(2 * degree + 1)]
        if degree and not any(name in attributes for name in names):
            break
        coefficients += [_attribute(glb, attributes, name, "VEC3") for name in names]
    if len({len(values) for values in coefficients}) > 1:
        raise ValueError(f"{glb.path}: expected as many values of each SH coefficient, found different numbers")
    return np.stack(coefficients, 1)


def _placed(path: Path, gaussians: Gaussians, matrix: Float[np.ndarray, "4 4"]) -> Gaussians:
    """The Gaussians in the frame of the scene."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not scale > 1e-9 or np.abs(linear / scale @ (linear / scale).T - np.eye(3)).max() > _RIGID:
        raise ValueError(f"{path}: expected nodes that rotate and scale uniformly, found another transform")
    return Similarity(
        scale=scale,
        rotation=torch.from_numpy(linear / scale).float(),
        translation=torch.from_numpy(matrix[:3, 3]).float(),
    ).gaussians(gaussians)
