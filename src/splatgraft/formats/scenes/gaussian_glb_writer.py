"""Writes binary glTF with KHR_gaussian_splatting (ratified 2026): float32 attributes of one POINTS primitive.

`gaussian_glb` reads the result and describes the attributes. glTF's unit is the metre and its y points up; the scene is
turned from the axes of a .ply, and is as upright and as large as it is given.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.axes import change_axes, rdf_from
from splatgraft.formats.scenes.gaussian_glb import GLTF_AXES, SPLATTING
from splatgraft.formats.scenes.glb_container import glb_bytes
from splatgraft.formats.scenes.quantized import bytes_from_unit, writable
from splatgraft.formats.scenes.scene_metadata import SceneMetadata
from splatgraft.runtime.atomic_file import atomic_write

_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gaussian_glb(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write all fields exactly but for the exponentials of scales and opacities.

    Args:
        path: The file.
        gaussians: The scene.
        metadata: Stands in the asset's extras.

    Raises:
        ValueError: There are no Gaussians, some are not finite, or the file would be larger than 4 GB.
    """
    g = change_axes(writable(path, gaussians, ".glb"), rdf_from(GLTF_AXES).T)
    arrays = _attributes(g)
    views, accessors, at = [], [], 0
    for values in arrays.values():
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": _FLOAT if values.dtype == np.float32 else _BYTE,
                "normalized": values.dtype != np.float32,
                "count": g.count,
                "type": _KINDS[values.shape[1]],
            }
        )
        at += values.nbytes
    # the specification asks for these of positions
    accessors[0] |= {"min": arrays["POSITION"].min(0).tolist(), "max": arrays["POSITION"].max(0).tolist()}
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    primitive = {
        "attributes": {name: index for index, name in enumerate(arrays)},
        "mode": _POINTS,
        "extensions": {SPLATTING: splats | {"sortingMethod": "cameraDistance"}},
    }
    extras = metadata.known
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "splatgraft"} | ({"extras": extras} if extras else {}),
        "extensionsUsed": [SPLATTING],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    data = glb_bytes(path, content, [values.tobytes() for values in arrays.values()])
    with atomic_write(path) as stream:
        for part in data:
            stream.write(part)


def _attributes(g: Gaussians) -> dict[str, np.ndarray]:
    """Attribute to rows of float32, positions first."""
    unit = torch.nn.functional.normalize(g.quaternions, dim=1)
    values = {
        "POSITION": g.means,
        f"{SPLATTING}:ROTATION": unit[:, [1, 2, 3, 0]],
        f"{SPLATTING}:SCALE": g.scales,
        f"{SPLATTING}:OPACITY": g.opacities[:, None],
    }
    for degree in range(g.sh_degree + 1):
        for index in range(2 * degree + 1):
            values[f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{index}"] = g.sh[:, degree * degree + index]
    arrays = {name: np.ascontiguousarray(value.numpy(), "<f4") for name, value in values.items()}
    # for programs without the extension: points in colour
    rgb = spherical_harmonics.rgb_from_dc(g.sh[:, 0])
    arrays["COLOR_0"] = bytes_from_unit(torch.cat([rgb, g.opacities[:, None]], 1)).numpy()
    return arrays
