"""Placements: angles, drop and rescale, duplicates beside the original."""

from functools import cache

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_project import ball, plane

from splatgraft.composition import object_base
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import concatenate
from splatgraft.core.rotations import rotation_between
from splatgraft.core.similarity import Similarity
from splatgraft.editor.placement import (
    PlaceableObject,
    degrees_of,
    drop_to_surface,
    place_beside,
    rescale,
    rotation_of,
    with_base,
)
from splatgraft.editor.session import Session

ANGLE = st.floats(-179, 179)
TURNS = st.tuples(ANGLE, st.floats(-89, 89), ANGLE)
POINT = st.tuples(*[st.floats(-10, 10)] * 3)
UP = torch.tensor([0.0, 0.0, 1.0])
FLOOR = Similarity(scale=4.0, rotation=torch.eye(3), translation=torch.tensor([0.0, 0.0, -1.0]))


@given(TURNS, POINT, st.floats(0.01, 100))
def test_a_typed_position_is_that_of_the_base_point(turns: tuple, at: tuple, scale: float) -> None:
    one = item()
    placed = with_base(one, Similarity(scale, rotation_of(turns), torch.zeros(3)), at=torch.tensor(at))
    assert placed.scale == scale
    # float32: 1e-7 of numbers up to 100 times the ball's half height, twice
    assert torch.allclose(placed.points(one.base.point), torch.tensor(at), atol=1e-3)
    assert torch.equal(placed.rotation, rotation_of(turns))


@given(TURNS)
def test_angles_to_rotation_and_back(turns: tuple) -> None:
    # a float32 matrix; near 90 degrees the arcsine loses half of its digits
    assert degrees_of(rotation_of(turns)) == pytest.approx(turns, abs=0.02)


def test_gimbal_lock_gives_the_same_rotation() -> None:
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert torch.allclose(rotation_of((0.0, 0.0, 90.0)), quarter, atol=1e-6)
    for pitch in (90.0, -90.0):
        rotation = rotation_of((30.0, pitch, 10.0))
        assert torch.allclose(rotation_of(degrees_of(rotation)), rotation, atol=1e-3)


def test_operations_keep_what_they_do_not_change(session: Session) -> None:
    item, up = session.placeable_object(0), torch.tensor([0.0, 0.0, 1.0])
    target = session.scenes.scene("target")
    start = session.objects()[0].target_from_object
    turned = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7, 0.4], [0.7, 0, 0], [-0.4, 0, 0]]))
    tilted = Similarity(scale=start.scale, rotation=turned @ start.rotation, translation=start.translation + 0.3 * up)
    fallen = drop_to_surface(target, item, tilted, up=up)
    assert fallen.scale == tilted.scale
    # the plane's Gaussians are a hundredth thick and were trained for sixty steps
    assert abs(float(fallen.points(item.base.point)[2])) < 0.1
    assert float(fallen.points(item.base.point)[2]) < float(tilted.points(item.base.point)[2])
    # the yaw stayed: headings of a horizontal vector agree, except for the slope of the plane
    side = torch.linalg.cross(item.base.up, torch.tensor([1.0, 0, 0]))
    straight = rotation_between(tilted.rotation @ item.base.up, up) @ tilted.rotation
    heads = [rotation @ side / side.norm() for rotation in (straight, fallen.rotation)]
    assert float(heads[0] @ heads[1]) > 0.98
    again = drop_to_surface(target, item, fallen, up=up)
    assert torch.allclose(again.translation, fallen.translation, atol=0.02)
    half = rescale(item, fallen, 0.5 * fallen.scale)
    assert torch.allclose(half.points(item.base.point), fallen.points(item.base.point), atol=1e-5)


@cache
def item() -> PlaceableObject:
    pose = look_at(torch.tensor([[2.0, 0, 1]]), torch.zeros(3), UP)
    return PlaceableObject(
        ball(), object_base(ball(), up=UP, surroundings=None), pinhole(pose, 45.0, width=48, height=36), None
    )


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.75, 0.0), (-0.75, 0.0), (0.7, 0.7), (-0.7, -0.7)])
def test_a_duplicate_near_a_table_s_edge_stays_on_the_table(at: tuple[float, float]) -> None:
    # a table of two units above a floor of eight
    target = concatenate([plane((0.5, 0.5, 0.5)), FLOOR.gaussians(plane((0.3, 0.3, 0.3)))])
    one = item()
    foot = one.base.point
    placed = Similarity(scale=0.5, rotation=torch.eye(3), translation=torch.tensor([*at, 0.0]) - 0.5 * foot)
    beside, is_supported = place_beside(target, one, placed, up=UP)
    assert is_supported
    stands = beside.points(foot)
    assert float(stands[:2].abs().max()) < 1.12  # the table's edge, and the width of its last Gaussians
    # a thickness of the table's Gaussians
    assert abs(float(stands[2])) < 0.05
    assert (
        float((stands - placed.points(foot))[:2].norm()) > 2 * 0.5 * 0.2
    )  # they do not touch: the ball has a radius of a quarter
    assert torch.equal(beside.rotation, placed.rotation)
    assert beside.scale == placed.scale


def test_where_nothing_is_beside_it_a_duplicate_is_said_to_be_in_the_air() -> None:
    one = item()
    pillar = Similarity(scale=0.1, rotation=torch.eye(3), translation=torch.zeros(3)).gaussians(plane((0.5, 0.5, 0.5)))
    placed = Similarity(scale=1.0, rotation=torch.eye(3), translation=-one.base.point)
    beside, is_supported = place_beside(pillar, one, placed, up=UP)
    assert not is_supported
    assert float(beside.points(one.base.point)[2]) == pytest.approx(0.0, abs=1e-6)
