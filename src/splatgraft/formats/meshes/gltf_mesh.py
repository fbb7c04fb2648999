"""Triangle meshes of glTF 2.0 with metallic-roughness materials (PNG, JPEG or WebP textures).

Read extensions: KHR_texture_transform, EXT_texture_webp, KHR_materials_emissive_strength, KHR_mesh_quantization. Other
ones are named in a note, or refused if the file requires them.
"""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from splatgraft.core.meshes import MAX_TRIANGLES, Mesh, MeshMaterial, Texture, Wrap, flat_normals, unit
from splatgraft.formats.gltf import AXES, Gltf, read_uri
from splatgraft.formats.scenes.axes import rdf_from

_READ = {"KHR_texture_transform", "EXT_texture_webp", "KHR_materials_emissive_strength", "KHR_mesh_quantization"}
_COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"}
_MAX_PIXELS = 1 << 26  # of one texture; 8192 x 8192
_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def read_gltf_mesh(gltf: Gltf, path: Path) -> tuple[Mesh, tuple[str, ...]]:
    """Read the triangles of all primitives, placed by their nodes; returns notes for the user as well."""
    notes = _check_extensions(gltf.content)
    materials = _Materials(gltf, path)
    parts: list[Mesh] = []
    count = 0
    for mesh, matrix in gltf.placed_meshes():
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) < _TRIANGLES:
                notes = (*notes, "its points and lines are not used") if len(notes) < 2 else notes
                continue
            vertex = _corners(gltf, primitive)
            count += len(vertex)
            if count > MAX_TRIANGLES:
                raise ValueError(f"expected at most {MAX_TRIANGLES:,} triangles, found {count:,} or more")
            parts.append(_placed(gltf, primitive, vertex, matrix))
    if not count:
        raise ValueError("expected a mesh or Gaussians, found a glTF without triangles")
    used = np.unique(np.concatenate([part.material for part in parts]))
    joined = {n: np.concatenate([getattr(part, n) for part in parts]) for n in ("corners", "normals", "uv", "colors")}
    material = np.searchsorted(used, np.concatenate([part.material for part in parts]))
    return Mesh(**joined, material=material, materials=tuple(materials.read(int(i)) for i in used)), notes


def _check_extensions(content: dict[str, Any]) -> tuple[str, ...]:
    required, used = (set(content.get(f"extensions{name}", [])) for name in ("Required", "Used"))
    if packed := sorted(used & _COMPRESSED & (required | {"KHR_draco_mesh_compression"})):
        raise ValueError(f"expected a mesh without compression, found {packed[0]}; export it without")
    if unknown := sorted(required - _READ):
        raise ValueError(f"expected only the extensions {', '.join(sorted(_READ))}, found {unknown[0][:60]!r}")
    if "KHR_materials_transmission" in used:
        return ("its glass (KHR_materials_transmission) is read as opaque",)
    unread = sorted(str(name)[:60] for name in used - _READ)
    return (f"not used: {', '.join(unread[:4])}",) if unread else ()


def _corners(gltf: Gltf, primitive: dict[str, Any]) -> Int[np.ndarray, "t 3"]:
    """Return the vertices of each triangle."""
    vertices = len(gltf.values(primitive["attributes"]["POSITION"], "VEC3"))
    index = np.arange(vertices)
    if "indices" in primitive:
        index = gltf.values(primitive["indices"], "SCALAR")[:, 0].astype(np.int64)
    if len(index) and not 0 <= int(index.min()) <= int(index.max()) < vertices:
        raise ValueError(f"expected indices of {vertices} vertices, found {int(index.min())} to {int(index.max())}")
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    first = np.arange(max(len(index) - 2, 0))
    if mode == _FAN:
        return np.stack([index[:1].repeat(len(first)), index[first + 1], index[first + 2]], 1)
    odd = first % 2  # every other triangle of a strip runs the other way
    return np.stack([index[first], index[first + 1 + odd], index[first + 2 - odd]], 1)


def _placed(gltf: Gltf, primitive: dict[str, Any], vertex: Int[np.ndarray, "t 3"], matrix: np.ndarray) -> Mesh:
    """Read one primitive; a mirroring transform turns its triangles round."""
    attributes = primitive["attributes"]
    linear = rdf_from(AXES).numpy().astype(np.float64) @ matrix[:3, :3]
    shift = rdf_from(AXES).numpy() @ matrix[:3, 3]
    if np.linalg.det(linear) < 0:
        vertex = vertex[:, ::-1]
    corners = (gltf.floats(attributes["POSITION"], "VEC3").astype(np.float64) @ linear.T + shift)[vertex]
    if not np.isfinite(corners).all():
        raise ValueError("expected finite positions, found others")
    normals = flat_normals(corners)
    if "NORMAL" in attributes:
        # cofactors, which exist for flattened meshes too, and keep a mirrored normal outside
        cofactors = np.stack([np.cross(linear[(i + 1) % 3], linear[(i + 2) % 3]) for i in range(3)])
        turned = gltf.floats(attributes["NORMAL"], "VEC3") @ cofactors.T * np.sign(np.linalg.det(linear) or 1)
        normals = np.where((turned != 0).any(1)[vertex][..., None], unit(turned)[vertex], normals)
    uv = np.zeros((len(vertex), 3, 2), np.float32)
    if "TEXCOORD_0" in attributes:
        uv = gltf.floats(attributes["TEXCOORD_0"], "VEC2")[vertex]
    colors = np.ones_like(corners, np.float32)
    if "COLOR_0" in attributes:
        colors = gltf.floats(attributes["COLOR_0"], "VEC3", "VEC4")[vertex][..., :3]
    material = np.full(len(vertex), primitive.get("material", -1))
    return Mesh(corners, normals, uv, colors, material, ())


class _Materials:
    """Reader of a file's materials; each image is decoded once."""

    def __init__(self, gltf: Gltf, path: Path) -> None:
        self._gltf, self._path = gltf, path
        self._images: dict[int, np.ndarray] = {}

    def read(self, index: int) -> MeshMaterial:
        """Read a material; the default one for -1."""
        found: dict[str, Any] = {} if index < 0 else self._gltf.content["materials"][index]
        surface, extensions = found.get("pbrMetallicRoughness", {}), found.get("extensions", {})
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        r, g, b, a = surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        er, eg, eb = (strength * x for x in found.get("emissiveFactor", (0.0, 0.0, 0.0)))
        mode, cutoff = found.get("alphaMode", "OPAQUE"), found.get("alphaCutoff", 0.5)
        return MeshMaterial(
            color=(r, g, b, a),
            metallic=surface.get("metallicFactor", 1.0),
            roughness=surface.get("roughnessFactor", 1.0),
            emission=(er, eg, eb),
            # a half transparent surface has no place among opaque Gaussians, so half decides
            alpha_cutoff={"OPAQUE": 0.0, "MASK": cutoff}.get(mode, 0.5),
            normal_scale=found.get("normalTexture", {}).get("scale", 1.0),
            color_map=self._texture(surface.get("baseColorTexture")),
            surface_map=self._texture(surface.get("metallicRoughnessTexture")),
            normal_map=self._texture(found.get("normalTexture")),
            emission_map=self._texture(found.get("emissiveTexture")),
        )

    def _texture(self, use: dict[str, Any] | None) -> Texture | None:
        if use is None:
            return None
        transform = use.get("extensions", {}).get("KHR_texture_transform", {})
        if transform.get("texCoord", use.get("texCoord", 0)) != 0:
            raise ValueError("expected textures on the first texture coordinates, found one on others")
        texture = self._gltf.content["textures"][use["index"]]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture)["source"]
        if source not in self._images:
            self._images[source] = self._image(self._gltf.content["images"][source])
        sampler = self._gltf.content["samplers"][texture["sampler"]] if "sampler" in texture else {}
        across: Wrap = _WRAPS[sampler.get("wrapS", 10497)]
        down: Wrap = _WRAPS[sampler.get("wrapT", 10497)]
        return _transformed(Texture(self._images[source], (across, down)), transform)

    def _image(self, image: dict[str, Any]) -> np.ndarray:
        data = self._gltf.view(image["bufferView"]) if "bufferView" in image else read_uri(self._path, image["uri"])
        return decode_image(data)


def decode_image(data: bytes) -> np.ndarray:
    """Decode a PNG, JPEG or WebP to (h, w, 4) bytes."""
    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "WEBP")) as picture:
        if picture.width * picture.height > _MAX_PIXELS:
            raise ValueError(f"expected a texture of at most 8192 x 8192, found {picture.width} x {picture.height}")
        return np.asarray(picture.convert("RGBA"))


def _transformed(texture: Texture, transform: dict[str, Any]) -> Texture:
    """Apply a KHR_texture_transform: offset, counterclockwise rotation and scale."""
    (u, v), (across, down) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    cosine, sine = np.cos(transform.get("rotation", 0.0)), np.sin(transform.get("rotation", 0.0))
    rows: Float[np.ndarray, "2 3"] = np.array([[cosine * across, sine * down, u], [-sine * across, cosine * down, v]])
    first, second = ((float(a), float(b), float(c)) for a, b, c in rows)
    return replace(texture, image_from_uv=(first, second))
