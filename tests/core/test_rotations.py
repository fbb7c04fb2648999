"""Rotations about an axis, between two vectors and to +z."""

import math

import pytest
import torch

from splatgraft.core.rotations import rotation_about, rotation_between, rotation_to_z

UNITS = torch.nn.functional.normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(0)), dim=1)
AXES = [*torch.eye(3), *-torch.eye(3), *UNITS]
# products of a few float32 numbers of at most one, each rounded by 6e-8
TOLERANCE = 1e-6


def is_rotation(matrix: torch.Tensor) -> bool:
    orthonormal = torch.allclose(matrix @ matrix.T, torch.eye(3), atol=TOLERANCE)
    return orthonormal and abs(float(torch.linalg.det(matrix)) - 1) < TOLERANCE


@pytest.mark.parametrize("axis", AXES)
def test_a_rotation_about_an_axis_keeps_it_and_turns_counterclockwise(axis):
    angle = 0.7
    rotation = rotation_about(axis, angle)
    assert is_rotation(rotation)
    assert torch.allclose(rotation @ axis, axis, atol=TOLERANCE)
    # the antisymmetric part of a rotation is sin(angle) times the cross product with its axis
    skew = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    assert torch.allclose(skew / 2, math.sin(angle) * axis, atol=TOLERANCE)


@pytest.mark.parametrize("start", AXES)
@pytest.mark.parametrize("end", AXES)
def test_the_rotation_between_two_vectors_is_the_smallest(start, end):
    rotation = rotation_between(start, end)
    assert is_rotation(rotation)
    assert torch.allclose(rotation @ start, end, atol=TOLERANCE)
    # its trace is 1 + 2 cos(angle), and no rotation turns by less than the angle between the vectors
    assert abs(float(rotation.trace()) - (1 + 2 * float(start @ end))) < 4 * TOLERANCE


@pytest.mark.parametrize("up", AXES)
def test_up_becomes_z(up):
    assert is_rotation(rotation_to_z(up))
    assert torch.allclose(rotation_to_z(up) @ up, torch.tensor([0.0, 0.0, 1.0]), atol=TOLERANCE)
