"""Selection: threshold, box and connected components; the default box."""

import math
from dataclasses import replace

import pytest
import torch
from conftest import BALL, splats
from hypothesis import given
from hypothesis import strategies as st

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import concatenate
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.segmentation import Box, SelectOptions, default_box, select_object


@given(threshold=st.floats(0.01, 0.99))
def test_threshold_is_inclusive(threshold):
    gaussians = splats(torch.zeros(3, 3), 0.1, 0.9, torch.ones(3, 3))
    feature = torch.tensor([threshold, threshold - 0.005, 1.0])
    chosen = select_object(gaussians, feature, SelectOptions(threshold=float(feature[0]), keep="all"))
    assert chosen.tolist() == [True, False, True]


def test_a_small_distant_component_is_removed(ball):
    crumb = splats(torch.tensor([[3.0, 0, 0], [3.05, 0, 0]]), 0.05, 0.99, torch.ones(2, 3))
    both = concatenate([ball, crumb])
    chosen = select_object(both, torch.ones(both.count))
    assert not chosen[BALL:].any()
    assert chosen[:BALL].float().mean() > 0.95
    assert select_object(both, torch.ones(both.count), SelectOptions(keep="all")).all()


def test_a_second_part_of_the_object_stays_unless_the_largest_alone_is_wanted(ball):
    away = Similarity(scale=0.5, rotation=torch.eye(3), translation=torch.tensor([3.0, 0, 0]))
    fainter = replace(ball, opacity_logits=ball.opacity_logits - 0.5)
    both = concatenate([ball, away.gaussians(fainter)])
    assert select_object(both, torch.ones(2 * BALL))[BALL:].float().mean() > 0.95
    alone = select_object(both, torch.ones(2 * BALL), SelectOptions(keep="largest"))
    assert alone[:BALL].float().mean() > 0.95
    assert not alone[BALL:].any()


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_components_do_not_depend_on_the_unit_of_length(ball, factor):
    crumb = splats(torch.tensor([[3.0, 0, 0]]), 0.05, 0.99, torch.ones(1, 3))
    both = concatenate([ball, crumb])
    unit = Similarity(scale=factor, rotation=torch.eye(3), translation=torch.zeros(3))
    feature = torch.ones(both.count)
    assert torch.equal(select_object(both, feature), select_object(unit.gaussians(both), feature))


def test_box_limits_the_centres(ball):
    box = Box(torch.tensor([-1.0, -1, 0]), torch.ones(3))
    chosen = select_object(ball, torch.ones(BALL), SelectOptions(box=box, keep="all"))
    assert torch.equal(chosen, ball.means[:, 2] >= 0)


def test_nothing_left_is_said(ball):
    with pytest.raises(ValueError, match=r"at least 0.75, found at most 0.20"):
        select_object(ball, torch.full((BALL,), 0.2))
    away = Box(torch.full((3,), 5.0), torch.full((3,), 6.0))
    with pytest.raises(ValueError, match="inside the box, found all outside"):
        select_object(ball, torch.ones(BALL), SelectOptions(box=away))


def test_a_box_has_its_corners_in_order():
    with pytest.raises(ValueError, match="lower < upper"):
        Box(torch.tensor([0.0, 0, 1]), torch.ones(3))


def test_default_box_holds_the_thing_on_the_floor_and_not_the_floor():
    generator = torch.Generator().manual_seed(0)
    floor = torch.cat([4 * torch.rand(2000, 2, generator=generator) - 2, torch.zeros(2000, 1)], 1)
    thing = torch.rand(400, 3, generator=generator) * torch.tensor([0.4, 0.3, 0.5]) - torch.tensor([0.2, 0.15, 0.0])
    angle = torch.arange(12) * (2 * math.pi / 12)
    eye = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full((12,), 1.2)], -1)
    poses = look_at(eye, torch.tensor([0.0, 0, 0.2]), torch.tensor([0.0, 0, 1]))
    cameras = pinhole(poses, 120.0, width=160, height=120)
    points = torch.cat([floor, thing])
    box = default_box(PosedImages((), cameras, points, torch.zeros(len(points), 3)))
    above = thing[thing[:, 2] > 0.08]
    assert box.contains(above).float().mean() > 0.95
    assert not box.contains(floor).any()
    # no more than the margins around a thing of at most half a unit
    assert (box.upper - box.lower).max() < 0.75
