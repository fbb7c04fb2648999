"""Reads .spz scenes (Niantic, versions 1 to 4) and writes version 3: quantised arrays, one per field.

Stored axes are right-up-back unless the file says otherwise, ours and a .ply's are right-down-front.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.axes import change_axes, rdf_from
from splatgraft.formats.scenes.quantized import bytes_from_unit, logits_from_bytes, require_finite, smallest_three
from splatgraft.formats.scenes.scene_file import SceneFile
from splatgraft.formats.scenes.spz_container import PackedScene, pack, unpack
from splatgraft.runtime.atomic_file import atomic_write

SPZ_VERSIONS = (2, 3, 4)
"""Those that are written; 1 is read as well."""
_COLOR_SCALE = 0.15
_HALF_SQRT2 = 0.5**0.5


def read_spz(path: Path) -> SceneFile:
    """The scene in a .spz file.

    Raises: ValueError where the file is cut, damaged, or of another version.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a .spz file, found none")
    gaussians, axes, notes = decode_spz(path, path.read_bytes())
    return SceneFile(change_axes(gaussians, rdf_from(axes)), axes, notes=notes)


def decode_spz(path: Path, data: bytes) -> tuple[Gaussians, str, tuple[str, ...]]:
    """The scene in the bytes of a .spz, in its own axes; their name; and what is said of it.

    Raises: ValueError where the bytes are cut, damaged, or of another version.
    """
    packed = unpack(path, data)
    notes = []
    if packed.antialiased:
        notes.append('trained with an anti-aliasing filter: set low_pass = "antialiased" in [render] and [consolidate]')
    if packed.degree > spherical_harmonics.MAX_DEGREE:
        notes.append(f"SH degree {packed.degree}: bands above {spherical_harmonics.MAX_DEGREE} are left out")
    positions, alphas, colors, scales, rotations, bands = (torch.from_numpy(field.copy()) for field in packed.fields)
    kept = spherical_harmonics.coefficient_count(min(packed.degree, spherical_harmonics.MAX_DEGREE)) - 1
    bands = bands.reshape(len(bands), bands.shape[1] // 3, 3)[:, :kept]
    gaussians = Gaussians(
        means=_half_floats(path, positions) if packed.version == 1 else _means(positions, packed.fractional_bits),
        log_scales=scales.float() / 16 - 10,
        quaternions=_smallest_three(rotations) if packed.version >= 3 else _first_three(rotations),
        opacity_logits=logits_from_bytes(alphas[:, 0]),
        sh=torch.cat([((colors.float() / 255 - 0.5) / _COLOR_SCALE)[:, None], (bands.float() - 128) / 128], 1),
    )
    return gaussians, packed.axes, tuple(notes)


def _half_floats(path: Path, positions: UInt8[Tensor, "n 6"]) -> Float[Tensor, "n 3"]:
    """Version 1: three 16-bit floats."""
    means = torch.from_numpy(positions.numpy().view("<f2").astype(np.float32))
    if not bool(means.isfinite().all()):
        raise ValueError(f"{path}: expected finite positions, found others")
    return means


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


def write_spz(path: Path, gaussians: Gaussians, *, version: int = 4) -> None:
    """Write positions in 24 bits of the scene's extent, the rest in 8 bits.

    Args:
        path: The file.
        gaussians: The scene.
        version: 4 (zstd streams), 3 (one gzip stream), or 2 (rotations in 3 bytes, for the oldest readers).

    Raises: ValueError where a Gaussian is not finite or further out than 8 million units, or the version is another.
    """
    if version not in SPZ_VERSIONS:
        raise ValueError(f"{path}: expected .spz version 2, 3 or 4 to write, found {version}")
    require_finite(path, gaussians)
    g = change_axes(gaussians.map(lambda tensor: tensor.detach().cpu().float()), rdf_from("RUB"))
    extent = float(g.means.abs().max()) if g.count else 1.0
    bits = max(b for b in range(-64, 24) if b < -60 or extent * 2.0**b <= 0x7FFFFF)
    if bits < 0:
        raise ValueError(f"{path}: expected positions within 8388607 units for a .spz file, found {extent:.4g}")
    fixed = (g.means.double() * 2.0**bits).round().to(torch.int64).numpy()
    fields = (
        np.stack([fixed & 0xFF, fixed >> 8 & 0xFF, fixed >> 16 & 0xFF], -1).astype(np.uint8).reshape(g.count, 9),
        bytes_from_unit(g.opacities)[:, None].numpy(),
        bytes_from_unit(g.sh[:, 0] * _COLOR_SCALE + 0.5).numpy(),
        ((g.log_scales + 10) * 16).round().clamp(0, 255).to(torch.uint8).numpy(),
        _three_bytes(g.quaternions) if version == 2 else _packed(g.quaternions),
        (g.sh[:, 1:] * 128 + 128).round().clamp(0, 255).to(torch.uint8).flatten(1).numpy(),
    )
    packed = PackedScene(version, g.sh_degree, bits, antialiased=False, axes="RUB", fields=fields)
    data = pack(path, packed)
    with atomic_write(path) as stream:
        stream.write(data)


def _three_bytes(quaternions: Float[Tensor, "n 4"]) -> np.ndarray:
    """x, y, z of a unit quaternion with w >= 0."""
    unit = torch.nn.functional.normalize(quaternions, dim=-1)
    xyz = torch.where(unit[:, :1] < 0, -unit, unit)[:, 1:]
    return ((xyz + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).numpy()


def _packed(quaternions: Float[Tensor, "n 4"]) -> np.ndarray:
    largest, three = smallest_three(quaternions[:, [1, 2, 3, 0]])
    magnitude = (three.abs() / _HALF_SQRT2 * 0x1FF).round().clamp(0, 0x1FF).to(torch.int64)
    fields = magnitude | (three < 0).to(torch.int64) << 9
    packed = largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return packed.numpy().astype("<u4")[:, None].view(np.uint8)
