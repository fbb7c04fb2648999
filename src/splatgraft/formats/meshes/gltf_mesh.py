"""Triangle meshes of glTF 2.0 with metallic-roughness materials (PNG, JPEG or WebP textures).

Read extensions: KHR_texture_transform, EXT_texture_webp, KHR_materials_emissive_strength, KHR_mesh_quantization. Other
ones are named in a note, or refused if the file requires them.
"""

import io
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from splatgraft.core.meshes import MAX_TRIANGLES, Mesh, MeshMaterial, Texture, Wrap, concatenate, make_mesh
from splatgraft.formats.gltf import AXES, Gltf, read_uri
from splatgraft.formats.scenes.axes import rdf_from

_READ = {"KHR_texture_transform", "EXT_texture_webp", "KHR_materials_emissive_strength", "KHR_mesh_quantization"}
_COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"}
_MAX_PIXELS = 1 << 26  # of one texture; 8192 x 8192
_REPEAT = 10497
_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror", _REPEAT: "repeat"}
_TRIANGLES, _FAN = 4, 6  # modes of a primitive; between them are strips, below them points and lines


def read_gltf_mesh(gltf: Gltf, path: Path) -> tuple[Mesh, tuple[str, ...]]:
    """Read the triangles of all primitives, placed by their nodes; returns notes for the user as well."""
    notes = _check_extensions(gltf.content)
    image = cache(lambda index: _image(gltf, path, index))
    material = cache(lambda index: _material(gltf, index, image))
    parts: list[Mesh] = []
    count = unused = 0
    for mesh, matrix in gltf.placed_meshes():
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) < _TRIANGLES:
                unused += 1
                continue
            faces = _faces(gltf, primitive)
            count += len(faces)
            if count > MAX_TRIANGLES:
                raise ValueError(f"expected at most {MAX_TRIANGLES:,} triangles, found {count:,} or more")
            parts.append(_placed(gltf, primitive, faces, matrix, material(primitive.get("material"))))
    if not count:
        raise ValueError("expected a mesh or Gaussians, found a glTF without triangles")
    return concatenate(parts), (*notes, "its points and lines are not used") if unused else notes


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


def _faces(gltf: Gltf, primitive: dict[str, Any]) -> Int[np.ndarray, "t 3"]:
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
    odd = first % 2  # every other triangle of a strip runs the other way
    corners = (0 * first, first + 1, first + 2) if mode == _FAN else (first, first + 1 + odd, first + 2 - odd)
    return index[np.stack(corners, 1)]


def _placed(
    gltf: Gltf,
    primitive: dict[str, Any],
    faces: Int[np.ndarray, "t 3"],
    matrix: Float[np.ndarray, "4 4"],
    material: MeshMaterial,
) -> Mesh:
    """Read one primitive; a mirroring transform turns its triangles round."""
    attributes = primitive["attributes"]
    turned = rdf_from(AXES).numpy() @ matrix[:3]
    linear, shift = turned[:, :3], turned[:, 3]
    side = np.sign(np.linalg.det(linear) or 1)

    def values(name: str, *kinds: str) -> Float[np.ndarray, "v c"] | None:
        return gltf.floats(attributes[name], *kinds) if name in attributes else None

    normals, colors = values("NORMAL", "VEC3"), values("COLOR_0", "VEC3", "VEC4")
    if normals is not None:
        # cofactors, which exist for flattened meshes too, and keep a mirrored normal outside
        normals = normals @ np.cross(np.roll(linear, -1, 0), np.roll(linear, -2, 0)).T * side
    return make_mesh(
        gltf.floats(attributes["POSITION"], "VEC3").astype(np.float64) @ linear.T + shift,
        faces if side > 0 else faces[:, ::-1],
        material=material,
        normals=normals,
        uv=values("TEXCOORD_0", "VEC2"),
        colors=None if colors is None else colors[:, :3],
    )


def _material(gltf: Gltf, index: int | None, image: Callable[[int], np.ndarray]) -> MeshMaterial:
    """Read a material; the default one for None."""
    found: dict[str, Any] = {} if index is None else gltf.content["materials"][index]
    surface, extensions = found.get("pbrMetallicRoughness", {}), found.get("extensions", {})
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    red, green, blue = (strength * x for x in found.get("emissiveFactor", (0.0, 0.0, 0.0)))
    return MeshMaterial(
        color=surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)),
        metallic=surface.get("metallicFactor", 1.0),
        roughness=surface.get("roughnessFactor", 1.0),
        emission=(red, green, blue),
        # a half transparent surface has no place among opaque Gaussians, so half decides
        alpha_cutoff={"OPAQUE": 0.0, "MASK": found.get("alphaCutoff", 0.5)}.get(found.get("alphaMode", "OPAQUE"), 0.5),
        normal_scale=found.get("normalTexture", {}).get("scale", 1.0),
        color_map=_texture(gltf, surface.get("baseColorTexture"), image),
        surface_map=_texture(gltf, surface.get("metallicRoughnessTexture"), image),
        normal_map=_texture(gltf, found.get("normalTexture"), image),
        emission_map=_texture(gltf, found.get("emissiveTexture"), image),
    )


def _texture(gltf: Gltf, use: dict[str, Any] | None, image: Callable[[int], np.ndarray]) -> Texture | None:
    """Read a texture; KHR_texture_transform scales, turns counterclockwise and shifts its coordinates."""
    if use is None:
        return None
    transform = use.get("extensions", {}).get("KHR_texture_transform", {})
    if transform.get("texCoord", use.get("texCoord", 0)) != 0:
        raise ValueError("expected textures on the first texture coordinates, found one on others")
    texture = gltf.content["textures"][use["index"]]
    source = texture.get("extensions", {}).get("EXT_texture_webp", texture)["source"]
    sampler = gltf.content["samplers"][texture["sampler"]] if "sampler" in texture else {}
    wrap = _WRAPS[sampler.get("wrapS", _REPEAT)], _WRAPS[sampler.get("wrapT", _REPEAT)]
    (u, v), (across, down) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    cosine, sine = np.cos(transform.get("rotation", 0.0)), np.sin(transform.get("rotation", 0.0))
    image_from_uv = np.array([[cosine * across, sine * down, u], [-sine * across, cosine * down, v]])
    return Texture(image(source), wrap, image_from_uv)


def _image(gltf: Gltf, path: Path, index: int) -> UInt8[np.ndarray, "h w 4"]:
    image = gltf.content["images"][index]
    data = gltf.view(image["bufferView"]) if "bufferView" in image else read_uri(path, image["uri"])
    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "WEBP")) as picture:
        return texture_pixels(picture)


def texture_pixels(picture: Image.Image) -> UInt8[np.ndarray, "h w 4"]:
    """Decode a picture of at most 8192 x 8192 pixels."""
    if picture.width * picture.height > _MAX_PIXELS:
        raise ValueError(f"expected a texture of at most 8192 x 8192, found {picture.width} x {picture.height}")
    return np.asarray(picture.convert("RGBA"))
