"""Lifting: the closed form is the weighted average, keeps its identities, and agrees with the trained features."""

from dataclasses import replace

import pytest
import torch
from conftest import BALL

from splatgraft.core.gaussians import concatenate
from splatgraft.rendering import render
from splatgraft.segmentation import LiftOptions, lift_masks


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


def test_object_and_surroundings_part_at_the_threshold(feature):
    chosen = feature >= 0.75
    # the ball's back is hidden by its front: seen by no camera, or only through gaps at the outline
    assert float(chosen[:BALL].float().mean()) > 0.45
    assert float(chosen[BALL:].float().mean()) < 0.01


def test_mask_and_complement_sum_to_one_where_seen(scene, cameras, masks, feature):
    other = lift_masks(scene, cameras, [1 - mask for mask in masks])
    total = feature + other
    # float32 sums; unseen Gaussians are 0 in both
    assert torch.all(torch.isclose(total, torch.tensor(1.0), atol=1e-4) | (total == 0))


def test_a_gaussian_behind_all_cameras_has_feature_zero(scene, cameras, masks):
    behind = replace(scene.select(torch.arange(3)), means=torch.tensor([[0.0, -50.0, 0.0]] * 3))
    assert lift_masks(concatenate([scene, behind]), cameras, masks)[-3:].tolist() == [0, 0, 0]


def test_trained_features_part_the_same_and_lower_the_cross_entropy(scene, cameras, masks, feature):
    def cross_entropy(values):
        logits = torch.logit(values, eps=0.01)[:, None]
        blended = render(scene, cameras, features=logits).features[..., 0]
        return float(torch.nn.functional.binary_cross_entropy_with_logits(blended, torch.stack(masks)))

    trained = lift_masks(scene, cameras, masks, LiftOptions(method="bce", iterations=120))
    assert cross_entropy(trained) < cross_entropy(feature)
    assert float((trained[:BALL] >= 0.75).float().mean()) > 0.45
    assert float((trained[BALL:] >= 0.75).float().mean()) < 0.03


def test_training_is_reproducible(scene, cameras, masks):
    options = LiftOptions(method="bce", iterations=5)
    first, second = (lift_masks(scene, cameras, masks, options) for _ in range(2))
    assert torch.equal(first, second)


def test_counts_and_sizes_must_fit(scene, cameras, masks):
    with pytest.raises(ValueError, match="expected one for each of 6 cameras, found 5"):
        lift_masks(scene, cameras, masks[:5])
    with pytest.raises(ValueError, match=r"view_0000: expected 96x72 pixels, found 96x71"):
        lift_masks(scene, cameras, [masks[0][1:], *masks[1:]])
