"""Conversions between gizmo, placement and angles."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.editor.session.gizmo import (
    Gizmo,
    degrees_from_quaternion,
    gizmo_from_similarity,
    quaternion_from_degrees,
    similarity_from_gizmo,
)

ANGLE = st.floats(-179, 179)
TURNS = st.tuples(ANGLE, st.floats(-89, 89), ANGLE)
POINT = st.tuples(*[st.floats(-10, 10)] * 3)


@given(TURNS, POINT, POINT, st.floats(0.01, 100))
def test_gizmo_to_placement_and_back(turns: tuple, at: tuple, pivot: tuple, scale: float) -> None:
    foot = torch.tensor(pivot)
    found = gizmo_from_similarity(similarity_from_gizmo(Gizmo(at, quaternion_from_degrees(turns), scale), foot), foot)
    assert found.scale == scale
    # float32: 1e-7 of numbers up to 100 times 18, twice
    assert torch.allclose(torch.tensor(found.position), torch.tensor(at), atol=1e-3)
    ours, theirs = (rotation_from_quaternion(torch.tensor([q])) for q in (found.wxyz, quaternion_from_degrees(turns)))
    # float32 quaternions: 1e-7, a few operations deep
    assert torch.allclose(ours, theirs, atol=1e-5)


@given(TURNS)
def test_angles_to_quaternion_and_back(turns: tuple) -> None:
    # double precision all the way; near 90 degrees the arcsine loses half of its digits
    assert degrees_from_quaternion(quaternion_from_degrees(turns)) == pytest.approx(turns, abs=1e-4)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_gimbal_lock_gives_the_same_rotation(pitch: float) -> None:
    wxyz = quaternion_from_degrees((30.0, pitch, 10.0))
    again = quaternion_from_degrees(degrees_from_quaternion(wxyz))
    assert abs(sum(a * b for a, b in zip(wxyz, again, strict=True))) == pytest.approx(1, abs=1e-6)


def test_a_rotation_about_one_axis() -> None:
    half = math.sqrt(0.5)
    assert quaternion_from_degrees((0.0, 0.0, 90.0)) == pytest.approx((half, 0, 0, half))
