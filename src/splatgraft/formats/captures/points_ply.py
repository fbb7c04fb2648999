"""Reads and writes coloured point clouds as .ply; reads Gaussians as points with their mean colour."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.formats.scenes import ply
from splatgraft.runtime.atomic_file import atomic_write

_POSITION = ("x", "y", "z")
_COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_GREY = 0.5


def read_points(path: Path) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Positions, and sRGB in [0, 1]: mid grey where the file has no colours, the mean colour for Gaussians.

    Raises: ValueError where the file is no whole PLY with finite x, y, z.
    """
    header = ply.read_header(path)
    vertex = header.element("vertex")
    if vertex is None or not set(_POSITION) <= set(vertex.names):
        found = [e.name for e in header.elements] if vertex is None else ", ".join(vertex.names)[:80]
        raise ValueError(f"{path}: expected an element 'vertex' with x, y, z, found {found}")
    names = next((trio for trio in (*_COLOR_NAMES, _DC) if set(trio) <= set(vertex.names)), ())
    table = torch.from_numpy(ply.read_columns(header, vertex, (*_POSITION, *names)))
    points, colors = table[:, :3].contiguous(), table[:, 3:].contiguous()
    if not names:
        colors = torch.full_like(points, _GREY)
    elif names == _DC:
        colors = spherical_harmonics.rgb_from_dc(colors).clamp(0, 1)
    else:
        kind = next(p.type for p in vertex.properties if p.name == names[0])
        colors = colors if kind[0] == "f" else colors / np.iinfo(kind).max
    if not bool(torch.isfinite(points).all()):
        bad = int((~torch.isfinite(points).all(1)).sum())
        raise ValueError(f"{path}: expected finite positions, found {bad} of {len(points)} points without")
    if not bool(((colors >= 0) & (colors <= 1)).all()):
        raise ValueError(f"{path}: expected colours as bytes, or as floats in [0, 1], found others")
    return points, colors


def write_points(path: Path, points: Float[Tensor, "m 3"], colors: Float[Tensor, "m 3"]) -> None:
    """Write float32 positions and 8-bit colours, atomically."""
    rows = np.empty(len(points), np.dtype([("position", "<f4", 3), ("color", "u1", 3)]))
    rows["position"] = points.detach().cpu().numpy()
    rows["color"] = (colors.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        properties = [("float", name) for name in _POSITION] + [("uchar", name) for name in _COLOR_NAMES[0]]
        ply.write_header(stream, ("vertex", len(rows), properties))
        stream.write(rows.tobytes())
