"""SuperSplat's compressed .ply: chunks of 256 Gaussians, quantised between the chunk's bounds.

Layout (PlayCanvas): element chunk with min and max of position, log scale and, in newer files, colour; element vertex
with four packed uint32; optional element sh with 8-bit f_rest. The writer sorts Gaussians along a Morton curve.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.quantization import (
    HALF_SQRT2,
    from_smallest_three,
    logits_from_bytes,
    morton_order,
    smallest_three,
    writable,
)
from splatgraft.formats.scenes.scene_file import SceneMetadata
from splatgraft.runtime.files import atomic_write

COMPRESSED_PLY = ".compressed.ply"
_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = ("{}_x {}_y {}_z", "{}_scale_x {}_scale_y {}_scale_z", "{}_r {}_g {}_b")
_POSITION_BITS = (11, 10, 11)
_LARGEST_LOG_SCALE = 20.0


def is_compressed(vertex: ply.Element) -> bool:
    """Whether the vertices are SuperSplat's packed ones."""
    return set(_PACKED) <= set(vertex.types)


def read_compressed_ply(header: ply.PlyHeader) -> Gaussians:
    """Read a compressed .ply."""
    vertex, chunk, sh = header.required("vertex"), header.required("chunk"), header.element("sh")
    columns = {name: np.empty(vertex.count, np.int64) for name in _PACKED}
    ply.read_into(header, vertex, list(columns.items()))
    position, rotation, scale, color = map(torch.from_numpy, columns.values())
    of_chunk = torch.arange(vertex.count) // _CHUNK

    def between(names: str, unit: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        low, high = (
            torch.from_numpy(ply.read_columns(header, chunk, tuple(name.format(end) for name in names.split())))
            for end in ("min", "max")
        )
        return torch.lerp(low[of_chunk], high[of_chunk], unit)

    rgb = _unpacked(color >> 8, (8, 8, 8))
    rgb = between(_BOUNDS[2], rgb) if "min_r" in chunk.types else rgb
    dc = spherical_harmonics.dc_from_rgb(rgb)[:, None]
    return Gaussians(
        means=between(_BOUNDS[0], _unpacked(position, _POSITION_BITS)),
        log_scales=between(_BOUNDS[1], _unpacked(scale, _POSITION_BITS)),
        quaternions=from_smallest_three(rotation >> 30, (_unpacked(rotation, (10, 10, 10)) - 0.5) / HALF_SQRT2),
        opacity_logits=logits_from_bytes((color & 255).to(torch.uint8)),
        sh=dc if sh is None else torch.cat([dc, _bands(header, sh, vertex.count)], 1),
    )


def _unpacked(packed: Int64[Tensor, "n"], bits: tuple[int, ...]) -> Float[Tensor, "n c"]:
    """Unpack values in [0, 1] that lie side by side, the last in the lowest bits."""
    shifts = [sum(bits[i + 1 :]) for i in range(len(bits))]
    parts = [(packed >> at & (1 << width) - 1) / ((1 << width) - 1) for at, width in zip(shifts, bits, strict=True)]
    return torch.stack(parts, 1).float()


def _bands(header: ply.PlyHeader, sh: ply.Element, count: int) -> Float[Tensor, "n k 3"]:
    """Decode bytes to [-4, 4]; channel-major as in a plain .ply."""
    names = tuple(f"f_rest_{i}" for i in range(len(sh.types)))
    values = torch.from_numpy(ply.read_columns(header, sh, names))
    unit = torch.where(values == 0, 0.0, torch.where(values == 255, 1.0, (values + 0.5) / 256))
    return ((unit - 0.5) * 8).reshape(count, 3, len(names) // 3).transpose(1, 2).contiguous()


def write_compressed_ply(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write positions and log scales in 11, 10 and 11 bits of the chunk's bounds, the rest in 8 to 10 bits."""
    g = writable(path, gaussians)
    g = g.select(morton_order(g.means))
    log_scales = g.log_scales.clamp(-_LARGEST_LOG_SCALE, _LARGEST_LOG_SCALE)
    values = torch.cat([g.means, log_scales, spherical_harmonics.rgb_from_dc(g.sh[:, 0])], 1)
    low, high = (torch.stack([bound(chunk, 0) for chunk in values.split(_CHUNK)]) for bound in (torch.amin, torch.amax))
    of_chunk = torch.arange(g.count) // _CHUNK
    unit = (values - low[of_chunk]) / (high - low)[of_chunk].clamp_min(1e-12)
    largest, three = smallest_three(g.quaternions)
    packed = [
        _packed(unit[:, :3], _POSITION_BITS),
        largest << 30 | _packed(three * HALF_SQRT2 + 0.5, (10, 10, 10)),
        _packed(unit[:, 3:6], _POSITION_BITS),
        _packed(torch.cat([unit[:, 6:], g.opacities[:, None]], 1), (8, 8, 8, 8)),
    ]
    bounds = [name.format(end) for names in _BOUNDS for end in ("min", "max") for name in names.split()]
    elements = [
        ("chunk", len(low), [("float", name) for name in bounds]),
        ("vertex", g.count, [("uint", name) for name in _PACKED]),
    ]
    bands = (g.sh[:, 1:].transpose(1, 2).flatten(1) / 8 + 0.5) * 256
    if g.sh_degree:
        elements.append(("sh", g.count, [("uchar", f"f_rest_{i}") for i in range(bands.shape[1])]))
    rows = torch.cat([low[:, :3], high[:, :3], low[:, 3:6], high[:, 3:6], low[:, 6:], high[:, 6:]], 1)
    with atomic_write(path) as stream:
        ply.write_header(stream, *elements, metadata=metadata)
        stream.write(rows.numpy().astype("<f4").tobytes())
        stream.write(torch.stack(packed, 1).numpy().astype("<u4").tobytes())
        stream.write(bands.floor().clamp(0, 255).to(torch.uint8).numpy().tobytes())


def _packed(unit: Float[Tensor, "n c"], bits: tuple[int, ...]) -> Int64[Tensor, "n"]:
    """Pack values in [0, 1] side by side, the last in the lowest bits."""
    out = torch.zeros(len(unit), dtype=torch.int64)
    for column, width in enumerate(bits):
        most = (1 << width) - 1
        out = out << width | (unit[:, column] * most).round().clamp(0, most).to(torch.int64)
    return out
