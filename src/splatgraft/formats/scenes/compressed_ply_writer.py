"""Writes SuperSplat's compressed .ply: 16 bytes per Gaussian and one byte per coefficient of the bands above 0.

Chunks of 256 Gaussians, sorted along a Morton curve, are quantised between their bounds; `compressed_ply` reads the
result and describes the fields.
"""

from pathlib import Path

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.morton_order import morton_order
from splatgraft.formats.scenes.ply_variants import comments_of
from splatgraft.formats.scenes.quantized import smallest_three, writable
from splatgraft.formats.scenes.scene_metadata import SceneMetadata
from splatgraft.runtime.atomic_file import atomic_write

COMPRESSED_PLY = ".compressed.ply"
_CHUNK = 256
_LARGEST_LOG_SCALE = 20.0
_HALF_SQRT2 = 0.5**0.5
_BOUNDS = ("{}_x", "{}_y", "{}_z", "{}_scale_x", "{}_scale_y", "{}_scale_z", "{}_r", "{}_g", "{}_b")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def write_compressed_ply(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write positions and log scales in 11, 10 and 11 bits of each chunk's bounds, the rest in 8 to 10 bits.

    Raises: ValueError where there are no Gaussians, or some are not finite.
    """
    g = writable(path, gaussians, "compressed .ply")
    g = g.select(morton_order(g.means))
    log_scales = g.log_scales.clamp(-_LARGEST_LOG_SCALE, _LARGEST_LOG_SCALE)
    values = torch.cat([g.means, log_scales, spherical_harmonics.rgb_from_dc(g.sh[:, 0])], 1)
    low, high = _bounds(values)
    of_chunk = torch.arange(g.count) // _CHUNK
    unit = (values - low[of_chunk]) / (high - low)[of_chunk].clamp_min(1e-12)
    color = torch.cat([unit[:, 6:], g.opacities[:, None]], 1)
    packed = [
        _packed(unit[:, :3], (11, 10, 11)),
        _packed_rotations(g.quaternions),
        _packed(unit[:, 3:6], (11, 10, 11)),
        _packed(color, (8, 8, 8, 8)),
    ]
    bands = (g.sh[:, 1:].transpose(1, 2).flatten(1) / 8 + 0.5) * 256
    elements = [
        ("chunk", len(low), [("float", name.format(end)) for part in (slice(0, 3), slice(3, 6), slice(6, 9))
                             for end in ("min", "max") for name in _BOUNDS[part]]),
        ("vertex", g.count, [("uint", name) for name in _PACKED]),
    ]  # fmt: skip
    if g.sh_degree:
        elements.append(("sh", g.count, [("uchar", f"f_rest_{i}") for i in range(bands.shape[1])]))
    rows = torch.cat([low[:, :3], high[:, :3], low[:, 3:6], high[:, 3:6], low[:, 6:], high[:, 6:]], 1)
    with atomic_write(path) as stream:
        ply.write_header(stream, *elements, comments=comments_of(metadata))
        stream.write(rows.numpy().astype("<f4").tobytes())
        stream.write(torch.stack(packed, 1).numpy().astype("<u4").tobytes())
        stream.write(bands.floor().clamp(0, 255).to(torch.uint8).numpy().tobytes())


def _bounds(values: Float[Tensor, "n c"]) -> tuple[Float[Tensor, "m c"], Float[Tensor, "m c"]]:
    """Least and greatest values of each chunk."""
    chunks = values.split(_CHUNK)
    return torch.stack([chunk.amin(0) for chunk in chunks]), torch.stack([chunk.amax(0) for chunk in chunks])


def _packed(unit: Float[Tensor, "n c"], bits: tuple[int, ...]) -> Int64[Tensor, "n"]:
    """Values of [0, 1] side by side, the first in the highest bits."""
    out = torch.zeros(len(unit), dtype=torch.int64)
    for column, width in enumerate(bits):
        most = (1 << width) - 1
        out = out << width | (unit[:, column] * most).round().clamp(0, most).to(torch.int64)
    return out


def _packed_rotations(quaternions: Float[Tensor, "n 4"]) -> Int64[Tensor, "n"]:
    """Index of the largest of w, x, y, z in two bits, then the others in 10 bits each."""
    largest, three = smallest_three(quaternions)
    return largest << 30 | _packed(three * _HALF_SQRT2 + 0.5, (10, 10, 10))
