"""Solidifying: a half-transparent object becomes opaque inside its masks and transparent outside."""

from dataclasses import replace

import pytest
import torch
from conftest import BALL, splats

from splatgraft.core.gaussians import concatenate
from splatgraft.rendering import render
from splatgraft.segmentation import SolidifyOptions, solidify_object


@pytest.fixture(scope="module")
def glassy(ball, wall):
    """The ball at a tenth of its opacity, with a spill of wall colour that the masks do not cover."""
    spill = splats(torch.tensor([[0.9, 0.0, 0.0]]), 0.1, 0.9, torch.tensor([[0.4, 0.4, 0.45]]))
    thin = replace(ball, opacity_logits=torch.full((BALL,), -2.0))
    return concatenate([thin, spill, wall])


def test_solid_inside_and_gone_outside(glassy, cameras, photographs, masks):
    selection = torch.arange(glassy.count) <= BALL
    views = list(zip(photographs, masks, strict=True))
    solid = solidify_object(glassy, selection, cameras, views, options=SolidifyOptions(iterations=200))
    inside = torch.nn.functional.avg_pool2d(torch.stack(masks)[:, None], 5, 1, 2)[:, 0] == 1
    outside = torch.nn.functional.max_pool2d(torch.stack(masks)[:, None], 5, 1, 2)[:, 0] == 0
    before, after = render(glassy.select(selection), cameras).alpha, render(solid, cameras).alpha
    assert solid.count == BALL + 1
    # two pixels from the outline; a solid surface has an alpha of nearly 1, an eighth is left for gaps of a coarse ball
    assert before[inside].mean() < 0.8
    assert after[inside].mean() > 0.93
    assert before[outside].max() > 0.5
    assert after[outside].max() < 0.35


def test_nothing_to_see_is_said(glassy, cameras, photographs):
    views = [(photo, torch.zeros(72, 96)) for photo in photographs]
    with pytest.raises(ValueError, match="found all empty"):
        solidify_object(glassy, torch.arange(glassy.count) < BALL, cameras, views)
