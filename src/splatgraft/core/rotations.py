"""Rotation matrices in 3D: from and to quaternions, about an axis (Rodrigues' formula), and between two vectors."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import perpendicular


def rotation_from_quaternion(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Convert wxyz quaternions of any length above zero to rotation matrices."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def quaternion_from_rotation(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Convert rotation matrices to unit wxyz quaternions, w >= 0; stable for every rotation."""
    m = rotations
    d = torch.diagonal(m, dim1=-2, dim2=-1)
    x, y, z = d.unbind(-1)
    squares = torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], -1)
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    e, f, g = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    rows = torch.stack(
        [
            torch.stack([squares[:, 0], a, b, c], -1),
            torch.stack([a, squares[:, 1], e, f], -1),
            torch.stack([b, e, squares[:, 2], g], -1),
            torch.stack([c, f, g, squares[:, 3]], -1),
        ],
        1,
    )
    # of four parallel candidates, the one with the largest component is the best conditioned
    best = rows[torch.arange(len(m), device=m.device), squares.argmax(-1)]
    best = torch.nn.functional.normalize(best, dim=-1)
    return torch.where(best[:, :1] < 0, -best, best)


def rotation_about(axis: Float[Tensor, "3"], angle: float) -> Float[Tensor, "3 3"]:
    """Compute the rotation by `angle`, radians, counterclockwise about unit `axis`, in float64 (Rodrigues)."""
    x, y, z = axis.double().tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    rotation = torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return rotation.to(axis)


def rotation_between(start: Float[Tensor, "3"], end: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Compute the smallest rotation from unit `start` to unit `end`; if opposite, some half turn."""
    axis = torch.linalg.cross(start, end)
    sine, cosine = float(axis.norm()), float(start @ end)
    # below float32's rounding the axis has no direction
    if sine < 1e-7:
        return torch.eye(3).to(start) if cosine > 0 else rotation_about(perpendicular(start), math.pi)
    return rotation_about(axis / sine, math.atan2(sine, cosine))


def rotation_to_z(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Compute a rotation that takes unit `up` to +z; its rows are two perpendicular axes and `up`."""
    x = -perpendicular(up)
    return torch.stack([x, torch.linalg.cross(up, x), up])
