"""Duplicates stand on the surface beside the original, at its height."""

import pytest
import torch
from tiny_project import ball, plane

from splatgraft.composition import object_base
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.editor.session.placement_operations import PlaceableObject, place_beside, snapped_angles

UP = torch.tensor([0.0, 0.0, 1.0])
FLOOR = Similarity(scale=4.0, rotation=torch.eye(3), translation=torch.tensor([0.0, 0.0, -1.0]))


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


def test_angles_snap_to_multiples() -> None:
    assert snapped_angles((7.0, -8.0, 97.6), 15.0) == (0.0, -15.0, 105.0)
