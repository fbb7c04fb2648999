"""The container of binary glTF 2.0: JSON, one buffer, accessors; and the transforms of nodes.

Lengths are compared with the bytes that are there before anything is decoded.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatgraft.formats.json_file import array, excerpt

_MAGIC, _VERSION = 0x46546C67, 2
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_HEADER_BYTES = 28
"""The file's header and those of the two chunks."""
_MOST_NODES = 10_000
_DEEPEST_NODE = 100


@dataclass(frozen=True)
class Glb:
    """A .glb file."""

    path: Path
    content: dict[str, Any]
    """Its JSON."""
    binary: bytes
    """Its buffer."""

    def entry(self, key: str, index: Any) -> dict[str, Any]:
        """An object of one of the JSON's top-level lists.

        Raises: ValueError where there is none.
        """
        entries = self.content.get(key)
        if not isinstance(entries, list) or not _is_whole(index) or not 0 <= index < len(entries):
            raise ValueError(f"{self.path}: expected an index into '{key}', found {excerpt(index)}")
        if not isinstance(entries[index], dict):
            raise ValueError(f"{self.path}: expected objects in '{key}', found {excerpt(entries[index])}")
        return entries[index]

    def view(self, index: Any) -> tuple[bytes, int]:
        """The bytes of a buffer view, and the distance of its elements; 0 where they are packed.

        Raises: ValueError where it leaves the buffer, or is in another file.
        """
        view = self.entry("bufferViews", index)
        start, length, stride = view.get("byteOffset", 0), view.get("byteLength", -1), view.get("byteStride", 0)
        if view.get("buffer") != 0 or "uri" in self.entry("buffers", 0):
            raise ValueError(f"{self.path}: expected data in the .glb itself, found another file or buffer")
        if not all(map(_is_whole, (start, length, stride))) or min(start, stride) < 0:
            raise ValueError(f"{self.path}: expected byte offsets in a buffer view, found {excerpt(view)}")
        if not 0 <= length <= len(self.binary) - start:
            raise ValueError(
                f"{self.path}: expected a buffer view within {len(self.binary)} bytes, found {start} + {length}"
            )
        return self.binary[start : start + length], stride

    def values(self, index: Any, kind: str) -> Float[np.ndarray, "n c"]:
        """An accessor's values; integers become [0, 1] or [-1, 1] where it is normalised.

        Raises: ValueError where it is of another kind than `kind` (VEC3, ...), or leaves its buffer view.
        """
        accessor = self.entry("accessors", index)
        if accessor.get("type") != kind or accessor.get("componentType") not in _COMPONENTS or "sparse" in accessor:
            raise ValueError(f"{self.path}: expected a plain accessor of {kind}, found {excerpt(accessor)}")
        data, stride = self.view(accessor.get("bufferView"))
        start, count = accessor.get("byteOffset", 0), accessor.get("count")
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[kind]
        size = dtype.itemsize * width
        stride = stride or size
        if not _is_whole(start) or not _is_whole(count) or min(start, count) < 0 or stride < size:
            raise ValueError(f"{self.path}: expected an offset, a count and a stride, found {excerpt(accessor)}")
        if count and start + (count - 1) * stride + size > len(data):
            raise ValueError(f"{self.path}: expected {count} values of {kind} in a view, found {len(data)} bytes")
        strides = (stride, dtype.itemsize)
        values = np.ndarray((count, width), dtype, data, start, strides) if count else np.empty((0, width))
        out = values.astype(np.float32)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            out = np.maximum(out / np.iinfo(dtype).max, -1)
        return out

    def nodes_with_meshes(self) -> Iterator[tuple[dict[str, Any], Float[np.ndarray, "4 4"]]]:
        """Each mesh of the default scene and the transform that places it; all meshes where there are no nodes.

        Raises: ValueError where nodes form a cycle, or there are more than 10,000.
        """
        if not self.content.get("nodes"):
            meshes = self.content.get("meshes")
            for i in range(len(meshes) if isinstance(meshes, list) else 0):
                yield self.entry("meshes", i), np.eye(4)
            return
        waiting = [(index, np.eye(4), 0) for index in self._roots()]
        visited = 0
        while waiting:
            index, parent, depth = waiting.pop(0)
            node = self.entry("nodes", index)
            visited += 1
            if visited > _MOST_NODES or depth > _DEEPEST_NODE:
                raise ValueError(f"{self.path}: expected at most {_MOST_NODES} nodes without cycles, found more")
            matrix = parent @ _matrix(self.path, node)
            if "mesh" in node:
                yield self.entry("meshes", node["mesh"]), matrix
            children = node.get("children", [])
            if not isinstance(children, list):
                raise ValueError(f"{self.path}: expected a list of child nodes, found {excerpt(children)}")
            waiting = [(child, matrix, depth + 1) for child in children] + waiting

    def _roots(self) -> list[Any]:
        if "scenes" not in self.content:
            children = {
                child
                for i in range(len(self.content["nodes"]))
                for child in self.entry("nodes", i).get("children", [])
                if _is_whole(child)
            }
            return [i for i in range(len(self.content["nodes"])) if i not in children]
        roots = self.entry("scenes", self.content.get("scene", 0)).get("nodes", [])
        if not isinstance(roots, list):
            raise ValueError(f"{self.path}: expected a list of nodes in the scene, found {excerpt(roots)}")
        return roots


def glb_bytes(path: Path, content: dict[str, Any], parts: Sequence[bytes]) -> list[bytes]:
    """A .glb as pieces to write one after another.

    Args:
        path: For messages.
        content: The JSON.
        parts: Of the buffer, whose length `content` states.

    Raises:
        ValueError: The file would be larger than the format's 4 GB.
    """
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    length = sum(map(len, parts))
    padding = bytes(-length % 4)
    total = _HEADER_BYTES + len(text) + length + len(padding)
    if total >= 1 << 32:
        raise ValueError(f"{path}: expected at most 4 GB for a .glb file, found {total / 1e9:.1f} GB")
    head = struct.pack("<5I", _MAGIC, _VERSION, total, len(text), _JSON)
    return [head, text, struct.pack("<2I", length + len(padding), _BINARY), *parts, padding]


def read_glb(path: Path) -> Glb:
    """A .glb file.

    Raises: ValueError where it is cut, of another kind, or its JSON is none.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a .glb file, found none")
    data = path.read_bytes()
    if len(data) < 12 or struct.unpack_from("<II", data) != (_MAGIC, _VERSION):
        raise ValueError(f"{path}: expected binary glTF of version 2, found {data[:8]!r}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        if length > len(data) - at - 8:
            raise ValueError(f"{path}: expected a chunk of {length} bytes, found {len(data) - at - 8}")
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    try:
        content = json.loads(chunks.get(_JSON, b""))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON in the first chunk, found {str(error)[:120]}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected an object as JSON, found a {type(content).__name__}")
    return Glb(path, content, chunks.get(_BINARY, b""))


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1 << 48


def _matrix(path: Path, node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """parent_from_node; column-major, or translation, rotation xyzw and scale."""
    if "matrix" in node:
        matrix = array(path, node, "matrix", ((16,),)).reshape(4, 4).T
    else:
        given = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]} | node
        x, y, z, w = array(path, given, "rotation", ((4,),))
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= array(path, given, "scale", ((3,),))
        matrix[:3, 3] = array(path, given, "translation", ((3,),))
    if not np.isfinite(matrix).all():
        raise ValueError(f"{path}: expected finite transforms of nodes, found others")
    return matrix
