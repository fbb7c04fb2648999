"""Binary glTF with KHR_gaussian_splatting (ratified 2026).

Attributes of a POINTS primitive: ROTATION (xyzw), SCALE (linear), OPACITY (linear), SH_DEGREE_l_COEF_n. The writer uses
float32; the reader accepts normalised integers as well, and applies the transforms of nodes. glTF's axes are
left-up-front and are turned to and from those of a .ply. Its unit is the metre, but scenes are neither set upright nor
scaled here; the asset's extras state the up direction in the file's axes, and the metres per unit.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.formats.scenes.axes import change_axes, rdf_from, turn_up
from splatgraft.formats.scenes.quantization import SMALLEST_SCALE, bytes_from_unit, writable
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata, stated_metadata
from splatgraft.runtime.files import atomic_write

AXES = "LUF"
"""Axes of the file: left, up, front."""
_GENERATOR = "splatgraft"  # extras of other programs may mean anything, and are not read
_SPLATTING = "KHR_gaussian_splatting"  # the extension, and the prefix of its attributes
_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_HEADER_BYTES = 28  # the file's header and those of the two chunks
_RIGID = 1e-3  # largest deviation of a node's matrix from a uniformly scaled rotation, over its scale
_MAX_DEPTH = 100  # deepest nesting of nodes
_OPACITY_STEP = 0.25 / 65535  # opacities of 0 and 1 become finite logits, by a quarter step of 16 bits


def read_gaussian_glb(path: Path) -> SceneFile:
    """Read the Gaussians of all primitives, placed by their nodes."""
    content, binary = _parts(path)
    notes: list[str] = []
    parts: list[Gaussians] = []
    for mesh, matrix in _placed_meshes(content):
        for primitive in mesh["primitives"]:
            if _SPLATTING in primitive.get("extensions", {}):
                part, said = _gaussians(content, binary, primitive)
                notes += [note for note in said if note not in notes]
                parts.append(_placed(part, matrix))
    if not parts:
        raise ValueError(f"expected Gaussians ({_SPLATTING}), found a .glb without")
    gaussians = change_axes(concatenate(parts), rdf_from(AXES))
    return SceneFile(gaussians, AXES, metadata=_metadata(content["asset"]), notes=tuple(notes))


def _metadata(asset: dict[str, Any]) -> SceneMetadata:
    """Read the extras that our writer states, in the axes of a .ply."""
    extras = asset.get("extras", {}) if asset.get("generator") == _GENERATOR else {}
    return turn_up(stated_metadata(extras.get("up"), extras.get("metres_per_unit")), rdf_from(AXES))


def _parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """Split the file into its JSON and its buffer."""
    data = path.read_bytes()
    if struct.unpack_from("<II", data) != (_MAGIC, _VERSION):
        raise ValueError(f"expected binary glTF of version 2, found {data[:8]!r}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return json.loads(chunks[_JSON]), chunks.get(_BINARY, b"")


def _placed_meshes(content: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Float[np.ndarray, "4 4"]]]:
    """Yield each mesh of the default scene and the transform that places it."""
    waiting = [(index, np.eye(4), 0) for index in content["scenes"][content.get("scene", 0)]["nodes"]]
    while waiting:
        index, parent, depth = waiting.pop(0)
        if depth > _MAX_DEPTH:
            raise ValueError(f"expected nodes without cycles, found more than {_MAX_DEPTH} levels")
        node = content["nodes"][index]
        matrix = parent @ _matrix(node)
        if "mesh" in node:
            yield content["meshes"][node["mesh"]], matrix
        waiting = [(child, matrix, depth + 1) for child in node.get("children", [])] + waiting


def _matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Compute parent_from_node, given as a column-major matrix, or as translation, rotation xyzw and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", [0, 0, 0, 1])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quaternion(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    matrix[:3, :3] *= np.array(node.get("scale", [1, 1, 1]), np.float64)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _gaussians(content: dict[str, Any], binary: bytes, primitive: dict[str, Any]) -> tuple[Gaussians, tuple[str, ...]]:
    """Read one primitive in glTF's axes; returns notes for the user as well."""
    extension, attributes = primitive["extensions"][_SPLATTING], primitive["attributes"]
    kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", "srgb_rec709_display")
    if kernel != "ellipse":
        raise ValueError(f"expected the kernel 'ellipse', found {str(kernel)[:60]!r}")
    notes = () if space == "srgb_rec709_display" else (f"its colours are {str(space)[:60]!r}; they are read as sRGB",)

    def values(name: str, kind: str) -> Float[np.ndarray, "n c"]:
        return _accessor(content, binary, content["accessors"][attributes[name]], kind)

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


def _accessor(content: dict[str, Any], binary: bytes, accessor: dict[str, Any], kind: str) -> Float[np.ndarray, "n c"]:
    """Read an accessor's values; normalised integers become [0, 1] or [-1, 1]."""
    view = content["bufferViews"][accessor["bufferView"]]
    if accessor["type"] != kind or "sparse" in accessor or view["buffer"] != 0 or "uri" in content["buffers"][0]:
        raise ValueError(f"expected a plain accessor of {kind} in the .glb itself, found another")
    dtype, width, count = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[kind], accessor["count"]
    start = view.get("byteOffset", 0)
    data = binary[start : start + view["byteLength"]]
    strides = (view.get("byteStride", dtype.itemsize * width), dtype.itemsize)
    if not count:
        return np.empty((0, width), np.float32)
    out = np.ndarray((count, width), dtype, data, accessor.get("byteOffset", 0), strides).astype(np.float32)
    return np.maximum(out / np.iinfo(dtype).max, -1) if accessor.get("normalized") and dtype.kind in "iu" else out


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
    kinds = {width: kind for kind, width in _WIDTHS.items()}
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
        stream.write(struct.pack("<5I", _MAGIC, _VERSION, total, len(text), _JSON) + text)
        stream.write(struct.pack("<2I", at + -at % 4, _BINARY))
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
