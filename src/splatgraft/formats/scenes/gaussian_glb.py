"""Binary glTF with KHR_gaussian_splatting (ratified 2026).

Attributes of a POINTS primitive: ROTATION (xyzw), SCALE (linear), OPACITY (linear), SH_DEGREE_l_COEF_n. The writer uses
float32; the reader accepts normalised integers as well, and applies the transforms of nodes. glTF's axes are
left-up-front and are turned to and from those of a .ply. Its unit is the metre, but scenes are neither set upright nor
scaled here; the asset's extras state the up direction in the file's axes, and the metres per unit.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.formats.gltf import AXES, BINARY_CHUNK, JSON_CHUNK, MAGIC, VERSION, WIDTHS, Gltf
from splatgraft.formats.scenes.axes import change_axes, rdf_from, turn_up
from splatgraft.formats.scenes.quantization import SMALLEST_SCALE, bytes_from_unit, writable
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata, stated_metadata
from splatgraft.runtime.files import atomic_write

_GENERATOR = "splatgraft"  # extras of other programs may mean anything, and are not read
_SPLATTING = "KHR_gaussian_splatting"  # the extension, and the prefix of its attributes
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_HEADER_BYTES = 28  # the file's header and those of the two chunks
_RIGID = 1e-3  # largest deviation of a node's matrix from a uniformly scaled rotation, over its scale
_OPACITY_STEP = 0.25 / 65535  # opacities of 0 and 1 become finite logits, by a quarter step of 16 bits


def has_gaussians(gltf: Gltf) -> bool:
    """Whether some primitive has Gaussians; all others are points, lines or triangles."""
    return any(_SPLATTING in p.get("extensions", {}) for m in gltf.content["meshes"] for p in m["primitives"])


def read_gaussian_glb(gltf: Gltf) -> SceneFile:
    """Read the Gaussians of all primitives, placed by their nodes."""
    notes: list[str] = []
    parts: list[Gaussians] = []
    for mesh, matrix in gltf.placed_meshes():
        for primitive in mesh["primitives"]:
            if _SPLATTING in primitive.get("extensions", {}):
                part, said = _gaussians(gltf, primitive)
                notes += [note for note in said if note not in notes]
                parts.append(_placed(part, matrix))
    if not parts:
        raise ValueError(f"expected Gaussians ({_SPLATTING}), found a .glb without")
    gaussians = change_axes(concatenate(parts), rdf_from(AXES))
    return SceneFile(gaussians, AXES, metadata=_metadata(gltf.content["asset"]), notes=tuple(notes))


def _metadata(asset: dict[str, Any]) -> SceneMetadata:
    """Read the extras that our writer states, in the axes of a .ply."""
    extras = asset.get("extras", {}) if asset.get("generator") == _GENERATOR else {}
    return turn_up(stated_metadata(extras.get("up"), extras.get("metres_per_unit")), rdf_from(AXES))


def _gaussians(gltf: Gltf, primitive: dict[str, Any]) -> tuple[Gaussians, tuple[str, ...]]:
    """Read one primitive in glTF's axes; returns notes for the user as well."""
    extension, attributes = primitive["extensions"][_SPLATTING], primitive["attributes"]
    kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", "srgb_rec709_display")
    if kernel != "ellipse":
        raise ValueError(f"expected the kernel 'ellipse', found {str(kernel)[:60]!r}")
    notes = () if space == "srgb_rec709_display" else (f"its colours are {str(space)[:60]!r}; they are read as sRGB",)

    def values(name: str, kind: str) -> Float[np.ndarray, "n c"]:
        return gltf.floats(attributes[name], kind)

    rotations, scales = values(f"{_SPLATTING}:ROTATION", "VEC4"), values(f"{_SPLATTING}:SCALE", "VEC3")
    if bool((scales < 0).any()):
        log_scales = scales
        notes = (*notes, "its scales are negative; they are read as logarithms, which drafts of the extension had")
    else:
        log_scales = np.log(np.maximum(scales, SMALLEST_SCALE))
    degree = sum(f"{_SPLATTING}:SH_DEGREE_{d}_COEF_0" in attributes for d in (1, 2, 3))
    coefficients = [values(name, "VEC3") for name in _harmonics(degree)]
    opacities = torch.from_numpy(values(f"{_SPLATTING}:OPACITY", "SCALAR")[:, 0].copy())
    gaussians = Gaussians(
        means=torch.from_numpy(values("POSITION", "VEC3")),
        log_scales=torch.from_numpy(log_scales),
        quaternions=torch.from_numpy(np.ascontiguousarray(rotations[:, [3, 0, 1, 2]])),
        opacity_logits=opacities.clamp(_OPACITY_STEP, 1 - _OPACITY_STEP).logit(),
        sh=torch.from_numpy(np.stack(coefficients, 1)),
    )
    return gaussians, notes


def _harmonics(degree: int) -> list[str]:
    """List the attributes of all bands up to a degree."""
    return [f"{_SPLATTING}:SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(2 * d + 1)]


def _placed(gaussians: Gaussians, matrix: Float[np.ndarray, "4 4"]) -> Gaussians:
    """Transform the Gaussians to the frame of the scene."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not scale > 1e-9 or not np.abs(linear / scale @ (linear / scale).T - np.eye(3)).max() < _RIGID:
        raise ValueError("expected nodes that rotate and scale uniformly, found another transform")
    rotation, translation = torch.from_numpy(linear / scale).float(), torch.from_numpy(matrix[:3, 3]).float()
    return Similarity(scale, rotation, translation).gaussians(gaussians)


def write_gaussian_glb(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write all fields exactly, except scales and opacities, which are converted; metadata as the asset's extras."""
    arrays = _attributes(change_axes(writable(path, gaussians), rdf_from(AXES).T))
    kinds = {width: kind for kind, width in WIDTHS.items()}
    views, accessors, at = [], [], 0
    for values in arrays.values():
        component = {"componentType": _FLOAT, "normalized": False}
        if values.dtype != np.float32:
            component = {"componentType": _BYTE, "normalized": True}
        shape = {"count": len(values), "type": kinds[values.shape[1]]}
        accessors.append({"bufferView": len(accessors), **component, **shape})
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        at += values.nbytes
    # the specification requires bounds of positions
    accessors[0] |= {"min": arrays["POSITION"].min(0).tolist(), "max": arrays["POSITION"].max(0).tolist()}
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    primitive = {
        "attributes": {name: index for index, name in enumerate(arrays)},
        "mode": _POINTS,
        "extensions": {_SPLATTING: splats | {"sortingMethod": "cameraDistance"}},
    }
    known = turn_up(metadata, rdf_from(AXES).T).known
    extras = {"extras": known} if known else {}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": _GENERATOR} | extras,
        "extensionsUsed": [_SPLATTING],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = _HEADER_BYTES + len(text) + at + -at % 4
    if total >= 1 << 32:
        raise ValueError(f"{path}: expected at most 4 GB for a .glb file, found {total / 1e9:.1f} GB")
    with atomic_write(path) as stream:
        stream.write(struct.pack("<5I", MAGIC, VERSION, total, len(text), JSON_CHUNK) + text)
        stream.write(struct.pack("<2I", at + -at % 4, BINARY_CHUNK))
        for values in arrays.values():
            stream.write(values.tobytes())
        stream.write(bytes(-at % 4))


def _attributes(g: Gaussians) -> dict[str, np.ndarray]:
    """Collect float32 rows by attribute, positions first, and COLOR_0 bytes for programs without the extension."""
    unit = torch.nn.functional.normalize(g.quaternions, dim=1)
    values = {
        "POSITION": g.means,
        f"{_SPLATTING}:ROTATION": unit[:, [1, 2, 3, 0]],
        f"{_SPLATTING}:SCALE": g.scales,
        f"{_SPLATTING}:OPACITY": g.opacities[:, None],
        **{name: g.sh[:, i] for i, name in enumerate(_harmonics(g.sh_degree))},
    }
    arrays = {name: np.ascontiguousarray(value.numpy(), "<f4") for name, value in values.items()}
    rgb = spherical_harmonics.rgb_from_dc(g.sh[:, 0])
    arrays["COLOR_0"] = bytes_from_unit(torch.cat([rgb, g.opacities[:, None]], 1)).numpy()
    return arrays
