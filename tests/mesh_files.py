"""Meshes as files, written without the package: glTF by hand, other formats as text or struct."""

import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

QUAD = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32)
"""A square of four units of area on the ground of glTF, whose y points up; its corners run clockwise from above."""


def cube(half: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return the 8 vertices and 12 triangles of a cube, counterclockwise from outside."""
    vertices = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint32)


def picture(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(stream, kind, **({"lossless": True} if kind == "WEBP" else {}))
    return stream.getvalue()


def glb(attributes: dict, indices: np.ndarray | None = None, *, images=(), **content) -> bytes:
    """Return a .glb with one primitive; `content` is merged into its JSON, `primitive` and `node` into those."""
    blob, views, accessors = b"", [], []

    def add(data: bytes) -> int:
        nonlocal blob
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob += data + bytes(-len(data) % 4)
        return len(views) - 1

    def accessor(values: np.ndarray, kind: str) -> int:
        component = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}[values.dtype.name]
        view = {"bufferView": add(values.tobytes()), "componentType": component, "count": len(values), "type": kind}
        accessors.append(view | ({"normalized": True} if values.dtype.kind == "u" and kind != "SCALAR" else {}))
        return len(accessors) - 1

    kinds = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
    named = {name: accessor(values, kinds[values.shape[1]]) for name, values in attributes.items()}
    primitive = {"attributes": named, **content.pop("primitive", {})}
    if indices is not None:
        primitive["indices"] = accessor(indices.reshape(-1), "SCALAR")
    found = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **content.pop("node", {})}],
        "meshes": [{"primitives": [primitive]}],
        "images": [{"bufferView": add(data)} for data in images],
        "textures": [{"source": i} for i in range(len(images))],
        **content,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(found).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(blob), len(text), 0x4E4F534A)
    return head + text + struct.pack("<2I", len(blob), 0x004E4942) + blob


def textured_quad(color: dict, *images: bytes, uv: np.ndarray | None = None, **content) -> bytes:
    """Return a .glb of the square with one material."""
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) if uv is None else uv
    attributes = {"POSITION": QUAD, "TEXCOORD_0": uv} | content.pop("attributes", {})
    corners = np.array([[0, 2, 1], [0, 3, 2]], np.uint16)
    primitive = {"material": 0} | content.pop("primitive", {})
    return glb(attributes, corners, images=images, materials=[color], primitive=primitive, **content)


def write_obj(folder: Path) -> Path:
    """Write two triangles, one red, one with a green texture."""
    (folder / "two.obj").write_text(
        "mtllib two.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\n"
        "usemtl red\nf 1/1/1 2/2/1 3/3/1\nusemtl printed\nf 1/1/1 3/3/1 4/4/1\n"
    )
    (folder / "two.mtl").write_text("newmtl red\nKd 1 0 0\nNs 30\nnewmtl printed\nKd 1 1 1\nmap_Kd green.png\n")
    (folder / "green.png").write_bytes(picture(np.full((4, 4, 3), (0, 255, 0))))
    return folder / "two.obj"


def write_stl(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    rows = np.zeros(len(faces), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
    rows["corners"] = vertices[faces]
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + rows.tobytes())
    return path


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, color=(255, 0, 0)) -> Path:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property float {a}" for a in "xyz")]
    lines += [*(f"property uchar {c}" for c in ("red", "green", "blue")), f"element face {len(faces)}"]
    lines += ["property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, [*vertex, *color])) for vertex in vertices]
    lines += [" ".join(map(str, [3, *face])) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path
