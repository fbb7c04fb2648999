"""Reads and writes .spz scenes (Niantic, versions 2 and 3): gzip of one quantised array per field.

Stored axes are right-up-back, ours and a .ply's are right-down-front: scenes are rotated by half a turn about x.
"""

import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.quantized import bytes_from_unit, logits_from_bytes, require_finite
from splatgraft.runtime.atomic_file import atomic_write

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_GZIP = 31
_DEFLATE_LIMIT = 1032
"""deflate cannot expand a byte to more than this."""
_COLOR_SCALE = 0.15
_HALF_SQRT2 = 0.5**0.5
_FLIP = torch.tensor([1.0, -1.0, -1.0])


def read_spz(path: Path) -> Gaussians:
    """The scene in a .spz file.

    Raises: ValueError where the file is cut, damaged, or of another version.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a .spz file, found none")
    data = path.read_bytes()
    if data[:4] == struct.pack("<I", _MAGIC):
        raise ValueError(f"{path}: expected .spz version 2 or 3 (gzip), found version 4 or later")
    inflate = zlib.decompressobj(_GZIP)
    head = _inflated(path, inflate, data, _HEADER.size)
    magic, version, n, degree, fractional_bits, _, _ = _HEADER.unpack(head)
    if magic != _MAGIC or version not in (2, 3) or degree > spherical_harmonics.MAX_DEGREE or fractional_bits > 24:
        raise ValueError(
            f"{path}: expected a .spz of version 2 or 3, SH degree up to 3, up to 24 fractional bits, "
            f"found magic {magic:#x}, version {version}, degree {degree}, {fractional_bits} bits"
        )
    k = spherical_harmonics.coefficient_count(degree) - 1
    widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * k)
    if n * sum(widths) > _DEFLATE_LIMIT * len(data):
        raise ValueError(f"{path}: expected {n} Gaussians as the header says, found only {len(data)} compressed bytes")
    body = _inflated(path, inflate, inflate.unconsumed_tail, n * sum(widths))
    rest = _step(path, inflate, inflate.unconsumed_tail, 1)
    if rest or not inflate.eof or inflate.unused_data:
        raise ValueError(f"{path}: expected the end of the gzip stream after {n} Gaussians, found more or a cut end")
    ends = np.cumsum([n * width for width in widths])
    fields = np.split(np.frombuffer(body, np.uint8), ends[:-1])
    positions, alphas, colors, scales, rotations, bands = (
        torch.from_numpy(field.reshape(n, width).copy()) for field, width in zip(fields, widths, strict=True)
    )
    sh = torch.cat(
        [((colors.float() / 255 - 0.5) / _COLOR_SCALE)[:, None], (bands.float().reshape(n, k, 3) - 128) / 128], 1
    )
    return _half_turn(
        Gaussians(
            means=_means(positions, fractional_bits),
            log_scales=scales.float() / 16 - 10,
            quaternions=_first_three(rotations) if version == 2 else _smallest_three(rotations),
            opacity_logits=logits_from_bytes(alphas[:, 0]),
            sh=sh,
        )
    )


def _inflated(path: Path, inflate, data: bytes, size: int) -> bytes:
    out = _step(path, inflate, data, size) if size else b""
    if len(out) < size:
        raise ValueError(f"{path}: expected {size} bytes in the gzip stream, found {len(out)}")
    return out


def _step(path: Path, inflate, data: bytes, limit: int) -> bytes:
    try:
        return inflate.decompress(data, limit)
    except zlib.error as error:
        raise ValueError(f"{path}: expected a whole gzip stream, found {error}") from None


def _means(positions: UInt8[Tensor, "n 9"], fractional_bits: int) -> Float[Tensor, "n 3"]:
    """24-bit signed fixed point."""
    low, middle, high = positions.reshape(-1, 3, 3).int().unbind(-1)
    fixed = low | middle << 8 | high << 16
    return torch.where(fixed >= 1 << 23, fixed - (1 << 24), fixed).float() / (1 << fractional_bits)


def _first_three(rotations: UInt8[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """x, y, z of a unit quaternion with w >= 0."""
    xyz = rotations.float() / 127.5 - 1
    return torch.cat([(1 - xyz.square().sum(1, keepdim=True)).clamp_min(0).sqrt(), xyz], 1)


def _smallest_three(rotations: UInt8[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Index of the largest of x, y, z, w in two bits, then the others in order: sign and 9 bits each."""
    packed = torch.from_numpy(rotations.numpy().view("<u4")[:, 0].astype(np.int64))
    largest = packed >> 30
    shifts = torch.tensor([20, 10, 0])
    three = packed[:, None] >> shifts & 0x3FF
    values = (three & 0x1FF).float() / 0x1FF * _HALF_SQRT2 * torch.where(three >> 9 == 1, -1.0, 1.0)
    axes = torch.arange(3) + (torch.arange(3) >= largest[:, None])
    xyzw = torch.zeros(len(packed), 4).scatter_(1, axes, values)
    xyzw = xyzw.scatter_(1, largest[:, None], (1 - values.square().sum(1, keepdim=True)).clamp_min(0).sqrt())
    return xyzw[:, [3, 0, 1, 2]]


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write version 3: positions in 24 bits of the scene's extent, the rest in 8 bits.

    Raises: ValueError where a Gaussian is not finite or further out than 8 million units.
    """
    require_finite(path, gaussians)
    g = _half_turn(gaussians.map(lambda tensor: tensor.detach().cpu().float()))
    extent = float(g.means.abs().max()) if g.count else 1.0
    bits = max(b for b in range(-64, 24) if b < -60 or extent * 2.0**b <= 0x7FFFFF)
    if bits < 0:
        raise ValueError(f"{path}: expected positions within 8388607 units for a .spz file, found {extent:.4g}")
    fixed = (g.means.double() * 2.0**bits).round().to(torch.int64).numpy()
    header = _HEADER.pack(_MAGIC, 3, g.count, g.sh_degree, bits, 0, 0)
    parts = [
        np.stack([fixed & 0xFF, fixed >> 8 & 0xFF, fixed >> 16 & 0xFF], -1).astype(np.uint8),
        bytes_from_unit(g.opacities).numpy(),
        bytes_from_unit(g.sh[:, 0] * _COLOR_SCALE + 0.5).numpy(),
        ((g.log_scales + 10) * 16).round().clamp(0, 255).to(torch.uint8).numpy(),
        _packed(g.quaternions),
        (g.sh[:, 1:] * 128 + 128).round().clamp(0, 255).to(torch.uint8).numpy(),
    ]
    deflate = zlib.compressobj(6, zlib.DEFLATED, _GZIP)
    with atomic_write(path) as stream:
        for part in (header, *(part.tobytes() for part in parts)):
            stream.write(deflate.compress(part))
        stream.write(deflate.flush())


def _packed(quaternions: Float[Tensor, "n 4"]) -> np.ndarray:
    xyzw = torch.nn.functional.normalize(quaternions, dim=-1)[:, [1, 2, 3, 0]]
    largest = xyzw.abs().argmax(1, keepdim=True)
    xyzw = torch.where(xyzw.gather(1, largest) < 0, -xyzw, xyzw)
    axes = torch.arange(3) + (torch.arange(3) >= largest)
    three = xyzw.gather(1, axes)
    magnitude = (three.abs() / _HALF_SQRT2 * 0x1FF).round().clamp(0, 0x1FF).to(torch.int64)
    fields = magnitude | (three < 0).to(torch.int64) << 9
    packed = largest[:, 0] << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return packed.numpy().astype("<u4")


def _half_turn(gaussians: Gaussians) -> Gaussians:
    """The scene rotated by half a turn about x, by exact changes of sign; its own inverse."""
    g = gaussians
    # every basis function is even or odd under the rotation; the sign at one generic direction decides which
    direction = torch.nn.functional.normalize(torch.tensor([0.31, 0.53, 0.79]), dim=0)
    basis = [spherical_harmonics.basis(d, g.sh_degree) for d in (direction, direction * _FLIP)]
    return Gaussians(
        means=g.means * _FLIP,
        log_scales=g.log_scales,
        quaternions=g.quaternions * torch.cat([torch.ones(1), _FLIP]),
        opacity_logits=g.opacity_logits,
        sh=g.sh * (basis[0] * basis[1]).sign()[:, None],
    )
