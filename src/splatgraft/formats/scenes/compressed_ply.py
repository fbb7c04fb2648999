"""Reads SuperSplat's compressed .ply: chunks of 256 Gaussians, quantised between each chunk's bounds.

Layout (PlayCanvas): element chunk with min/max of position, log scale and, in newer files, colour; element vertex with
four packed uint32; optional element sh with 8-bit f_rest.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.quantized import logits_from_bytes

_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_HALF_SQRT2 = 0.5**0.5


def is_compressed(header: ply.PlyHeader) -> bool:
    """Whether the file has SuperSplat's packed vertices."""
    vertex = header.element("vertex")
    return vertex is not None and set(_PACKED) <= set(vertex.names)


def read_compressed_ply(header: ply.PlyHeader) -> Gaussians:
    """The scene in a compressed .ply.

    Raises: ValueError where chunks, packed columns or f_rest are missing or do not fit each other.
    """
    path, vertex, chunk, sh = header.path, *(header.element(name) for name in ("vertex", "chunk", "sh"))
    if vertex is None or chunk is None or chunk.count * _CHUNK < vertex.count:
        found = chunk.count if chunk else 0
        raise ValueError(f"{path}: expected one chunk for {_CHUNK} packed Gaussians, found {found}")
    if any(p.type != "u4" for p in vertex.properties if p.name in _PACKED):
        raise ValueError(f"{path}: expected {', '.join(_PACKED)} as uint, found other types")
    packed = [np.empty(vertex.count, np.int64) for _ in _PACKED]
    for start, rows in ply.read_chunks(header, vertex):
        for column, name in zip(packed, _PACKED, strict=True):
            column[start : start + len(rows)] = rows[name]
    position, rotation, scale, color = map(torch.from_numpy, packed)
    of_chunk = torch.arange(vertex.count) // _CHUNK
    unit_rgb = torch.stack([color >> 24 & 255, color >> 16 & 255, color >> 8 & 255], 1).float() / 255
    has_colors = {"min_r", "max_r"} <= set(chunk.names)
    rgb = _between(header, chunk, "{}_r {}_g {}_b", unit_rgb, of_chunk) if has_colors else unit_rgb
    dc = spherical_harmonics.dc_from_rgb(rgb)[:, None]
    return Gaussians(
        means=_between(header, chunk, "{}_x {}_y {}_z", _three(position), of_chunk),
        log_scales=_between(header, chunk, "{}_scale_x {}_scale_y {}_scale_z", _three(scale), of_chunk),
        quaternions=_quaternions(rotation),
        opacity_logits=logits_from_bytes((color & 255).to(torch.uint8)),
        sh=dc if sh is None else torch.cat([dc, _bands(header, sh, vertex.count)], 1),
    )


def _three(packed: Int64[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """11, 10 and 11 bits, each to [0, 1]."""
    return torch.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], 1).float()


def _quaternions(packed: Int64[Tensor, "n"]) -> Float[Tensor, "n 4"]:
    """Index of the largest of w, x, y, z in two bits, then the others in order in 10 bits each."""
    largest = packed[:, None] >> 30
    three = packed[:, None] >> torch.tensor([20, 10, 0]) & 1023
    values = (three.float() / 1023 - 0.5) / _HALF_SQRT2
    axes = torch.arange(3) + (torch.arange(3) >= largest)
    out = torch.zeros(len(packed), 4).scatter_(1, axes, values)
    return out.scatter_(1, largest, (1 - values.square().sum(1, keepdim=True)).clamp_min(0).sqrt())


def _between(
    header: ply.PlyHeader, chunk: ply.Element, names: str, unit: Float[Tensor, "n 3"], of_chunk: Int64[Tensor, "n"]
) -> Float[Tensor, "n 3"]:
    """`unit` between each chunk's lower and upper bound; `names` says how the bounds are called."""
    bounds = []
    for end in ("min", "max"):
        columns = tuple(name.format(end) for name in names.split())
        missing = [name for name in columns if name not in chunk.names]
        if missing:
            raise ValueError(f"{header.path}: expected {', '.join(columns)} in element 'chunk', found no {missing[0]}")
        bounds.append(torch.from_numpy(ply.read_columns(header, chunk, columns))[of_chunk])
    return torch.lerp(bounds[0], bounds[1], unit)


def _bands(header: ply.PlyHeader, sh: ply.Element, count: int) -> Float[Tensor, "n k 3"]:
    """Bytes to [-4, 4], channel-major as in a plain .ply."""
    names = tuple(f"f_rest_{i}" for i in range(len(sh.properties)))
    if sh.count != count or len(names) not in (9, 24, 45) or set(names) != set(sh.names):
        raise ValueError(
            f"{header.path}: expected {count} rows of 9, 24 or 45 f_rest in element 'sh', "
            f"found {sh.count} rows of {len(names)}"
        )
    values = torch.from_numpy(ply.read_columns(header, sh, names))
    unit = torch.where(values == 0, 0.0, torch.where(values == 255, 1.0, (values + 0.5) / 256))
    return ((unit - 0.5) * 8).reshape(count, 3, len(names) // 3).transpose(1, 2).contiguous()
