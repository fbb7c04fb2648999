"""GrabCut from a 3D box: finds an object of a distinct colour; the second pass corrects a wrong mask of one view."""

import pytest
import torch

from splatgraft.segmentation import Box, grabcut_masks, refine_masks

BOX = Box(torch.full((3,), -0.65), torch.full((3,), 0.65))


def overlap(a, b):
    return float((a * b).sum() / ((a + b) > 0).sum())


def test_the_ball_is_found_in_every_view(photographs, cameras, masks, ball):
    found = grabcut_masks(photographs, cameras, BOX, ball.means)
    # a pixel of uncertain outline all around a disc of 15 px radius is 13% of its area
    assert min(overlap(a, b) for a, b in zip(found, masks, strict=True)) > 0.87
    assert all(set(mask.unique().tolist()) <= {0.0, 1.0} for mask in found)


def test_the_other_views_correct_a_wrong_mask(photographs, cameras, masks, scene):
    spoilt = [mask.clone() for mask in masks]
    spoilt[2][40:70, 5:40] = 1
    mended = refine_masks(spoilt, photographs, cameras, scene)
    assert overlap(spoilt[2], masks[2]) < 0.6
    assert overlap(mended[2], masks[2]) > 0.87


def test_it_is_reproducible(photographs, cameras, ball):
    first, second = (grabcut_masks(photographs[:1], cameras[:1], BOX, ball.means) for _ in range(2))
    assert torch.equal(first[0], second[0])


def test_a_box_out_of_sight_or_empty_is_refused(photographs, cameras, ball):
    with pytest.raises(ValueError, match="at least 4 sparse points of the capture inside it, found 0"):
        grabcut_masks(photographs, cameras, Box(torch.full((3,), 5.0), torch.full((3,), 6.0)), ball.means)
    aside = Box(torch.tensor([20.0, 1, 0]), torch.tensor([21.0, 2, 1]))
    points = aside.lower + torch.rand(10, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="view_0000 to see it, found it outside the picture"):
        grabcut_masks(photographs, cameras, aside, points)
    behind = Box(torch.full((3,), -10.0), torch.full((3,), -9.0))
    with pytest.raises(ValueError, match="found it around or behind"):
        grabcut_masks(photographs, cameras, behind, behind.lower + 0.5 * torch.rand(10, 3))
