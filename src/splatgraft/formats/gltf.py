"""The glTF 2.0 container: its JSON and buffers, values of accessors, and the meshes that its nodes place."""

import base64
import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from jaxtyping import Float

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.runtime.settings import MAX_TEXT_BYTES

AXES = "LUF"
"""Axes of the file: left, up, front."""
MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
"""Numbers in the headers of a .glb and of its chunks."""
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Numbers in one value of an accessor, by its type."""


@dataclass(frozen=True)
class Gltf:
    """The content of a .glb or .gltf."""

    content: dict[str, Any]
    """The JSON."""
    buffers: tuple[bytes, ...]
    """Bytes of the buffers."""

    def view(self, index: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.content["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start : start + view["byteLength"]]

    def values(self, index: int, *kinds: str) -> np.ndarray:
        """Read an accessor of one of the types `kinds`, (n, width), in its own number type."""
        accessor = self.content["accessors"][index]
        if accessor["type"] not in kinds or "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"expected a plain accessor of {' or '.join(kinds)} in the file itself, found another")
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        count, row = accessor["count"], dtype.itemsize * width
        stride = self.content["bufferViews"][accessor["bufferView"]].get("byteStride", row)
        if not count:
            return np.empty((0, width), dtype)
        if stride < row:
            raise ValueError(f"expected a byteStride of {row} or more, found {stride}")
        data = self.view(accessor["bufferView"])
        return np.ndarray((count, width), dtype, data, accessor.get("byteOffset", 0), (stride, dtype.itemsize)).copy()

    def floats(self, index: int, *kinds: str) -> Float[np.ndarray, "n c"]:
        """Read an accessor as float32; normalised integers become [0, 1] or [-1, 1]."""
        found = self.values(index, *kinds)
        out = found.astype(np.float32)
        normalised = self.content["accessors"][index].get("normalized") and found.dtype.kind in "iu"
        return np.maximum(out / np.iinfo(found.dtype).max, -1) if normalised else out

    def placed_meshes(self) -> Iterator[tuple[dict[str, Any], Float[np.ndarray, "4 4"]]]:
        """Yield each mesh of the default scene and the transform that places it."""
        content = self.content
        waiting = [(index, np.eye(4)) for index in content["scenes"][content.get("scene", 0)]["nodes"]]
        met: set[int] = set()
        while waiting:
            index, parent = waiting.pop(0)
            if index in met:
                raise ValueError(f"expected nodes without cycles, found node {index} twice")
            met.add(index)
            node = content["nodes"][index]
            if "skin" in node:
                raise ValueError("expected a mesh without a skeleton, found a skin; export it with its pose applied")
            matrix = parent @ _matrix(node)
            if "mesh" in node:
                yield content["meshes"][node["mesh"]], matrix
            waiting = [(child, matrix) for child in node.get("children", [])] + waiting


def read_gltf(path: Path) -> Gltf:
    """Read a .glb, or a .gltf with the files that it names."""
    if path.suffix.lower() == ".gltf":
        if (size := path.stat().st_size) > 8 * MAX_TEXT_BYTES:
            raise ValueError(f"expected at most {8 * MAX_TEXT_BYTES >> 20} MiB of JSON, found {size >> 20} MiB")
        content = json.loads(path.read_bytes())
        return Gltf(content, tuple(read_uri(path, buffer["uri"]) for buffer in content.get("buffers", [])))
    data = path.read_bytes()
    if struct.unpack_from("<II", data) != (MAGIC, VERSION):
        raise ValueError(f"expected binary glTF of version 2, found {data[:8]!r}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    content = json.loads(chunks[JSON_CHUNK])
    given: Sequence[dict[str, Any]] = content.get("buffers", [])
    return Gltf(content, tuple(read_uri(path, b["uri"]) if "uri" in b else chunks[BINARY_CHUNK] for b in given))


def read_uri(path: Path, uri: str) -> bytes:
    """Read the bytes that a glTF file names: base64 text, or a file in its folder."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition("base64,")[2])
    file = path.parent / unquote(uri)
    if not file.resolve().is_relative_to(path.parent.resolve()) or not file.is_file():
        raise ValueError(f"expected the file {uri[:80]!r} in the folder of the glTF, found none there")
    return file.read_bytes()


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
