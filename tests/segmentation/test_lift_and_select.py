"""Masks lifted to Gaussians, the selection by threshold, box and component, and their combination in `segment`."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from ball_views import BALL, splats

from splatgraft.core.gaussians import concatenate
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.rendering import render
from splatgraft.segmentation import (
    Box,
    LiftOptions,
    SelectOptions,
    SolidifyOptions,
    lift_masks,
    part_shares,
    segment,
    select_object,
)
from splatgraft.steps.segment import _part_notes


@pytest.fixture(scope="module")
def feature(scene, cameras, masks):
    return lift_masks(scene, cameras, masks)


def test_closed_form_is_the_weighted_average_of_the_differentiable_render(scene, cameras, masks, feature):
    ones = torch.zeros(scene.count, 1, requires_grad=True)
    blended = render(scene, cameras, features=ones).features[..., 0]
    inside = torch.autograd.grad((blended * torch.stack(masks)).sum(), ones, retain_graph=True)[0][:, 0]
    seen = torch.autograd.grad(blended.sum(), ones)[0][:, 0]
    clear = seen > 0.01
    # the same sums in another order, float32, up to a few thousand pixels
    assert torch.allclose(feature[clear], (inside / seen)[clear], atol=1e-4)
    # the ball's front hides its back from every camera, except through gaps at the outline
    assert float((feature[:BALL] >= 0.75).float().mean()) > 0.45
    assert float((feature[BALL:] >= 0.75).float().mean()) < 0.01


def test_mask_and_complement_sum_to_one_where_seen_and_to_zero_behind(scene, cameras, masks):
    behind = replace(scene.select(torch.arange(3)), means=torch.tensor([[0.0, -50.0, 0.0]] * 3))
    more = concatenate([scene, behind])
    total = lift_masks(more, cameras, masks) + lift_masks(more, cameras, [1 - mask for mask in masks])
    # float32 sums; unseen Gaussians are 0 in both
    assert torch.all(torch.isclose(total, torch.tensor(1.0), atol=1e-4) | (total == 0))
    assert total[-3:].tolist() == [0, 0, 0]


def test_trained_features_part_the_same_lower_the_cross_entropy_and_are_reproducible(scene, cameras, masks, feature):
    def cross_entropy(values):
        logits = torch.logit(values, eps=0.01)[:, None]
        blended = render(scene, cameras, features=logits).features[..., 0]
        return float(torch.nn.functional.binary_cross_entropy_with_logits(blended, torch.stack(masks)))

    trained = lift_masks(scene, cameras, masks, LiftOptions(method="bce", iterations=60))
    assert cross_entropy(trained) < cross_entropy(feature)
    assert float((trained[:BALL] >= 0.75).float().mean()) > 0.45
    assert float((trained[BALL:] >= 0.75).float().mean()) < 0.03
    short = LiftOptions(method="bce", iterations=5)
    first, second = (lift_masks(scene, cameras, masks, short) for _ in range(2))
    assert torch.equal(first, second)


def test_counts_and_sizes_of_masks_must_fit(scene, cameras, masks):
    with pytest.raises(ValueError, match="expected one for each of 6 cameras, found 5"):
        lift_masks(scene, cameras, masks[:5])
    with pytest.raises(ValueError, match=r"view_0000: expected 96x72 pixels, found 96x71"):
        lift_masks(scene, cameras, [masks[0][1:], *masks[1:]])


@pytest.mark.parametrize("factor", [1.0, 1e-3])
def test_a_small_distant_component_is_removed_in_any_unit_of_length(ball, factor):
    crumb = splats(torch.tensor([[3.0, 0, 0], [3.05, 0, 0]]), 0.05, 0.99, torch.ones(2, 3))
    unit = Similarity(scale=factor, rotation=torch.eye(3), translation=torch.zeros(3))
    both = unit.gaussians(concatenate([ball, crumb]))
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
    large, small = part_shares(both)
    assert large + small == pytest.approx(1)
    assert 0.4 < small < large
    (note,) = _part_notes([large, small], Path("views.png"))
    assert note.level == "warning"
    assert f"2 separate parts, of {large:.0%} and {small:.0%}" in note.text
    assert not _part_notes(part_shares(both.select(alone)), Path("views.png"))


def test_threshold_is_inclusive_box_limits_the_centres_and_nothing_left_is_said(ball):
    box, heights = Box(torch.tensor([-1.0, -1, 0]), torch.ones(3)), ball.means[:, 2]
    options = SelectOptions(threshold=float(heights.median()), box=box, keep="all")
    assert torch.equal(select_object(ball, heights, options), heights >= max(0.0, options.threshold))
    with pytest.raises(ValueError, match=r"at least 0.75, found at most 0.20"):
        select_object(ball, torch.full((BALL,), 0.2))
    away = Box(torch.full((3,), 5.0), torch.full((3,), 6.0))
    with pytest.raises(ValueError, match="inside the box, found all outside"):
        select_object(ball, torch.ones(BALL), SelectOptions(box=away))
    with pytest.raises(ValueError, match="lower < upper"):
        Box(torch.tensor([0.0, 0, 1]), torch.ones(3))


def test_segment_lifts_selects_and_solidifies_the_object_alone(scene, cameras, masks, photographs, tmp_path):
    images, files = ([tmp_path / f"{kind}{i}.png" for i in range(6)] for kind in ("image", "mask"))
    for index in range(6):
        write_image(images[index], photographs[index])
        write_image(files[index], masks[index])
    none = torch.zeros(0, 3)
    # the last view has no mask
    capture = PosedImages(tuple(images), cameras, none, none, mask_paths=(*files[:5], None))
    plain, solid = (segment(scene, capture, solidify=how) for how in (None, SolidifyOptions(iterations=3)))
    assert torch.equal(plain.feature, lift_masks(scene, cameras[:5], masks[:5]))
    assert torch.equal(plain.selection, select_object(scene, plain.feature))
    alone, fitted = (one.object.select(~one.is_guessed) for one in (plain, solid))
    assert torch.equal(alone.means, scene.means[plain.selection])
    # the cameras are in an arc before it
    assert bool(plain.is_guessed.any())
    assert torch.equal(plain.surroundings.sh, scene.sh[~plain.selection])
    assert torch.equal(plain.selection, solid.selection)
    assert torch.equal(plain.surroundings.opacity_logits, solid.surroundings.opacity_logits)
    assert not torch.equal(alone.opacity_logits, fitted.opacity_logits)
    with pytest.raises(ValueError, match="expected masks of the object for some of 6 views, found none"):
        segment(scene, replace(capture, mask_paths=()))
