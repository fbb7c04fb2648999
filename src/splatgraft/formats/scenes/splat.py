""".splat scenes: 32 bytes per Gaussian, colour without view dependence.

Layout (antimatter15/splat): position 3 x float32, scale 3 x float32, colour and opacity 4 x uint8,
quaternion wxyz 4 x uint8 as 128 + 128 q.
"""

from pathlib import Path

import numpy as np
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.quantization import bytes_from_unit, from_linear, writable
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata
from splatgraft.runtime.files import atomic_write

_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)])


def read_splat(path: Path) -> SceneFile:
    """Read a .splat file; SH degree 0."""
    data = path.read_bytes()
    if not data or len(data) % _ROW.itemsize:
        raise ValueError(f"expected a multiple of {_ROW.itemsize} bytes above 0, found {len(data)}")
    rows = {name: torch.from_numpy(np.frombuffer(data, _ROW)[name].copy()) for name in _ROW.names or ()}
    quaternions = (rows["quaternion"].float() - 128) / 128
    gaussians = from_linear(rows["position"], rows["scale"], quaternions, rows["rgba"])
    return SceneFile(gaussians, notes=("the format has colours without view dependence",))


def write_splat(path: Path, gaussians: Gaussians, _: SceneMetadata = SceneMetadata()) -> None:
    """Write positions and scales exactly, the rest in 8 bits; bands above 0 are lost."""
    g = writable(path, gaussians)
    rows = np.empty(g.count, _ROW)
    rows["position"] = g.means.numpy()
    rows["scale"] = g.scales.numpy()
    rows["rgba"][:, :3] = bytes_from_unit(spherical_harmonics.rgb_from_dc(g.sh[:, 0])).numpy()
    rows["rgba"][:, 3] = bytes_from_unit(g.opacities).numpy()
    unit = torch.nn.functional.normalize(g.quaternions, dim=-1)
    rows["quaternion"] = (unit * 128 + 128).round().clamp(0, 255).to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        stream.write(rows.tobytes())
