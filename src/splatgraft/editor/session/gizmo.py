"""Between a gizmo (a pose at an object's foot, and a size) and the `Similarity` that places the object.

Knows nothing about browsers or scenes.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from splatgraft.core.similarity import Similarity

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Gizmo:
    """What a person drags: it stands where the object's pivot stands."""

    position: Triple
    """Of the pivot, in the target."""
    wxyz: tuple[float, float, float, float]
    """How the object is turned."""
    scale: float
    """Size in the target over size in the object's capture."""


def gizmo_of(move: Similarity, pivot: Float[Tensor, "3"]) -> Gizmo:
    """The gizmo of an object placed by `move`, at `pivot` of the object's own frame."""
    quaternion = quaternion_from_rotation(move.rotation[None])[0].tolist()
    return Gizmo(_triple(move.points(pivot)), (quaternion[0], *quaternion[1:]), move.scale)


def similarity_of(gizmo: Gizmo, pivot: Float[Tensor, "3"]) -> Similarity:
    """The placement that puts `pivot` where the gizmo is."""
    rotation = rotation_from_quaternion(torch.tensor([gizmo.wxyz], dtype=torch.float64))[0]
    translation = torch.tensor(gizmo.position, dtype=torch.float64) - gizmo.scale * rotation @ pivot.double()
    return Similarity(scale=gizmo.scale, rotation=rotation.float(), translation=translation.float())


def degrees_of(wxyz: tuple[float, float, float, float]) -> Triple:
    """Turns about the fixed x, then y, then z axis, in degrees: what a person types."""
    m = rotation_from_quaternion(torch.tensor([wxyz], dtype=torch.float64))[0]
    pitch = math.asin(max(-1.0, min(1.0, -float(m[2, 0]))))
    # looking straight along y, x and z turn about the same axis: all of it is given to z
    if abs(float(m[2, 0])) > 1 - 1e-9:
        roll, yaw = 0.0, math.atan2(-float(m[0, 1]), float(m[1, 1]))
    else:
        roll, yaw = math.atan2(float(m[2, 1]), float(m[2, 2])), math.atan2(float(m[1, 0]), float(m[0, 0]))
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def wxyz_of(degrees: Triple) -> tuple[float, float, float, float]:
    """The quaternion of turns about the fixed x, then y, then z axis."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(math.radians(d) / 2), math.sin(math.radians(d) / 2)) for d in degrees)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _triple(values: Tensor) -> Triple:
    x, y, z = values.tolist()
    return x, y, z
