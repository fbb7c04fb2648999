"""Conversions between a gizmo (pose at an object's base point, and scale) and the object's `Similarity`."""

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
    """Pose and scale of the transform gizmo, which is shown at the object's pivot."""

    position: Triple
    """Position of the pivot in the target."""
    wxyz: tuple[float, float, float, float]
    """Rotation from the object's to the target's axes."""
    scale: float
    """Size in the target over size in the object's capture."""


def gizmo_from_similarity(target_from_object: Similarity, pivot: Float[Tensor, "3"]) -> Gizmo:
    """The gizmo of an object placed by `target_from_object`, at `pivot` of the object's own frame."""
    quaternion = quaternion_from_rotation(target_from_object.rotation[None])[0].tolist()
    return Gizmo(_triple(target_from_object.points(pivot)), (quaternion[0], *quaternion[1:]), target_from_object.scale)


def similarity_from_gizmo(gizmo: Gizmo, pivot: Float[Tensor, "3"]) -> Similarity:
    """The placement that puts `pivot` where the gizmo is."""
    rotation = rotation_from_quaternion(torch.tensor([gizmo.wxyz], dtype=torch.float64))[0]
    translation = torch.tensor(gizmo.position, dtype=torch.float64) - gizmo.scale * rotation @ pivot.double()
    return Similarity(scale=gizmo.scale, rotation=rotation.float(), translation=translation.float())


def degrees_from_quaternion(wxyz: tuple[float, float, float, float]) -> Triple:
    """Rotation angles about the fixed x, then y, then z axis, in degrees."""
    m = rotation_from_quaternion(torch.tensor([wxyz], dtype=torch.float64))[0]
    pitch = math.asin(max(-1.0, min(1.0, -float(m[2, 0]))))
    # gimbal lock: at a pitch of 90 degrees x and z rotate about the same axis; all of it goes to z
    if abs(float(m[2, 0])) > 1 - 1e-9:
        roll, yaw = 0.0, math.atan2(-float(m[0, 1]), float(m[1, 1]))
    else:
        roll, yaw = math.atan2(float(m[2, 1]), float(m[2, 2])), math.atan2(float(m[1, 0]), float(m[0, 0]))
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def quaternion_from_degrees(degrees: Triple) -> tuple[float, float, float, float]:
    """The quaternion wxyz of rotations about the fixed x, then y, then z axis, in degrees."""
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
