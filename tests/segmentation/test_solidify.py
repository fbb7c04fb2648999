"""Solidifying: a half-transparent object becomes opaque inside its masks and transparent outside."""

from dataclasses import replace

import pytest
import torch
from ball_views import BALL, splats

from splatgraft.core.gaussians import concatenate
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.rendering import render
from splatgraft.segmentation import SolidifyOptions, solidify_object


@pytest.fixture(scope="module")
def glassy(ball, wall):
    """Return the ball at a tenth of its opacity, with a spill of wall colour outside of the masks."""
    spill = splats(torch.tensor([[0.9, 0.0, 0.0]]), 0.1, 0.9, torch.tensor([[0.4, 0.4, 0.45]]))
    thin = replace(ball, opacity_logits=torch.full((BALL,), -2.0))
    return concatenate([thin, spill, wall])


def test_solid_inside_and_gone_outside(glassy, cameras, photographs, masks):
    selection = torch.arange(glassy.count) <= BALL
    views = list(zip(photographs, masks, strict=True))
    solid = solidify_object(
        glassy, selection, cameras, views, options=SolidifyOptions(iterations=200, pixels_per_gaussian=0.0)
    )
    inside = torch.nn.functional.avg_pool2d(torch.stack(masks)[:, None], 5, 1, 2)[:, 0] == 1
    outside = torch.nn.functional.max_pool2d(torch.stack(masks)[:, None], 5, 1, 2)[:, 0] == 0
    before, after = render(glassy.select(selection), cameras).alpha, render(solid, cameras).alpha
    # the spill is outside of all masks, and the ball's Gaussians at its outline stay
    assert solid.count == BALL
    # two pixels from the outline; a solid surface has an alpha of nearly 1, an eighth is left for gaps of a coarse ball
    assert before[inside].mean() < 0.8
    assert after[inside].mean() > 0.93
    assert before[outside].max() > 0.5
    assert after[outside].max() < 0.35
    nothing = [(photo, torch.zeros(72, 96)) for photo in photographs]
    with pytest.raises(ValueError, match="found all empty"):
        solidify_object(glassy, selection, cameras, nothing)


def test_a_strand_that_two_of_six_masks_contain_is_removed(scene, cameras, photographs, masks):
    heights = torch.linspace(0.6, 1.2, 20)
    places = torch.stack([0.2 * heights, torch.full((20,), 0.5), heights], 1)
    pole = splats(places, 0.06, 0.95, torch.full((20, 3), 0.4))
    whole = concatenate([scene.select(torch.arange(scene.count) < BALL), pole, scene])
    selection = torch.arange(whole.count) < BALL + 20
    wrong = [(alpha > 0.5).float() for alpha in render(whole.select(selection), cameras).alpha]
    views = list(zip(photographs, [*wrong[:2], *masks[2:]], strict=True))
    solid = solidify_object(
        whole, selection, cameras, views, options=SolidifyOptions(iterations=20, pixels_per_gaussian=0.0)
    )
    assert float(solid.means[:, 2].max()) < 0.7
    # a Gaussian at the outline may move out of it
    assert solid.count > 0.98 * BALL


def test_a_coarse_object_gets_as_many_gaussians_as_its_photographs_show(scene, ball, cameras, masks):
    # stripes that the Gaussians of a coarse ball cannot show
    pictures = [photo * mask[..., None] for photo, mask in zip(striped(scene, cameras), masks, strict=True)]
    coarse = concatenate([ball.select(torch.arange(BALL) % 8 == 0), scene.select(torch.arange(scene.count) >= BALL)])
    wide = replace(coarse, log_scales=coarse.log_scales + 1.0)
    selection = torch.arange(wide.count) < BALL // 8
    views = list(zip(pictures, masks, strict=True))

    def error(options):
        solid = solidify_object(wide, selection, cameras, views, options=options)
        drawn = render(solid, cameras).color
        inside = torch.stack(masks)[..., None]
        return solid.count, float((inside * (drawn - torch.stack(pictures))).square().sum() / inside.sum())

    few, before = error(SolidifyOptions(iterations=200, pixels_per_gaussian=0.0))
    many, after = error(SolidifyOptions(iterations=200, pixels_per_gaussian=2.0))
    assert few == BALL // 8
    median = float(torch.tensor([float(mask.sum()) for mask in masks]).median())
    assert few < many <= median / 2
    assert after < 0.8 * before


def test_what_no_photograph_shows_gets_the_colour_of_what_is_beside_it(scene, ball, cameras, masks, monkeypatch):
    # a red spot on the ball's far side, which no camera sees
    behind = ball.means[:, 1] > 0.35
    red = dc_from_rgb(torch.tensor([[0.9, 0.0, 0.0]]))
    painted = torch.cat([behind, torch.zeros(scene.count - BALL, dtype=torch.bool)])
    # wide enough to leave no gaps
    wide = torch.where(torch.arange(scene.count) < BALL, 0.6, 0.0)[:, None]
    spotted = replace(scene, sh=torch.where(painted[:, None, None], red, scene.sh), log_scales=scene.log_scales + wide)
    pictures = [photo * mask[..., None] for photo, mask in zip(render(scene, cameras).color, masks, strict=True)]
    views = list(zip(pictures, masks, strict=True))
    options, is_ball = SolidifyOptions(iterations=60, pixels_per_gaussian=0.0), torch.arange(scene.count) < BALL
    solid = solidify_object(spotted, is_ball, cameras, views, options=options)
    monkeypatch.setattr("splatgraft.segmentation.solidify._HIDDEN", 0.0)
    kept = solidify_object(spotted, is_ball, cameras, views, options=options)
    green = rgb_from_dc(solid.sh[:, 0])[:, 1]
    assert float(rgb_from_dc(kept.sh[behind, 0])[:, 1].mean()) < 0.15
    # the ball's own is 0.7
    assert float(green[behind].mean()) > 0.55
    front = ball.means[:, 1] < -0.2
    assert torch.equal(solid.sh[front], kept.sh[front])


def striped(scene, cameras):
    """Return the scene photographed with dark and light stripes on the ball, 8 over its height."""
    stripes = torch.where((scene.means[:, 2] * 20).sin() > 0, 0.2, 0.9)[:, None].expand(-1, 3)
    is_ball = torch.arange(scene.count) < BALL
    sh = torch.where(is_ball[:, None, None], dc_from_rgb(stripes)[:, None], scene.sh[:, :1])
    return list(render(replace(scene, sh=sh), cameras).color)
