"""Gizmo and placement are two words for one thing."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.editor.session.gizmo import Gizmo, degrees_of, gizmo_of, similarity_of, wxyz_of

ANGLE = st.floats(-179, 179)
TURNS = st.tuples(ANGLE, st.floats(-89, 89), ANGLE)
POINT = st.tuples(*[st.floats(-10, 10)] * 3)


@given(TURNS, POINT, POINT, st.floats(0.01, 100))
def test_a_gizmo_comes_back_from_its_placement(turns: tuple, at: tuple, pivot: tuple, scale: float) -> None:
    foot = torch.tensor(pivot)
    found = gizmo_of(similarity_of(Gizmo(at, wxyz_of(turns), scale), foot), foot)
    assert found.scale == scale
    # float32: 1e-7 of numbers up to 100 times 18, twice
    assert torch.allclose(torch.tensor(found.position), torch.tensor(at), atol=1e-3)
    ours, theirs = (rotation_from_quaternion(torch.tensor([q])) for q in (found.wxyz, wxyz_of(turns)))
    # float32 quaternions: 1e-7, a few operations deep
    assert torch.allclose(ours, theirs, atol=1e-5)


@given(TURNS)
def test_typed_degrees_come_back(turns: tuple) -> None:
    # double precision all the way; near 90 degrees the arcsine loses half of its digits
    assert degrees_of(wxyz_of(turns)) == pytest.approx(turns, abs=1e-4)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_straight_up_and_down_is_the_same_turn(pitch: float) -> None:
    wxyz = wxyz_of((30.0, pitch, 10.0))
    again = wxyz_of(degrees_of(wxyz))
    assert abs(sum(a * b for a, b in zip(wxyz, again, strict=True))) == pytest.approx(1, abs=1e-6)


def test_one_axis_turns_as_one_expects() -> None:
    half = math.sqrt(0.5)
    assert wxyz_of((0.0, 0.0, 90.0)) == pytest.approx((half, 0, 0, half))
