"""A side of an object without photographs is closed: opaque, in the colours beside it, and nowhere else."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import UP, surfels

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import psnr
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.rendering import render
from splatgraft.segmentation import close_unseen_side

CENTER = torch.tensor([0.3, -0.2, 0.5])


def egg(spot_deg: float) -> Gaussians:
    """Return an egg on a floor at z = .2, painted from red to blue along its axis, with a green spot on one side."""
    around = even_directions(6000)
    radii = torch.tensor([0.5, 0.3, 0.3])
    normals = torch.nn.functional.normalize(around / radii, dim=1)
    share = 0.5 + 0.5 * around[:, :1]
    rgb = share * torch.tensor([0.8, 0.2, 0.2]) + (1 - share) * torch.tensor([0.2, 0.3, 0.8])
    spot = torch.tensor([math.cos(math.radians(spot_deg)), math.sin(math.radians(spot_deg)), -0.3])
    rgb = torch.where((normals @ spot > 0.9)[:, None], torch.tensor([0.1, 0.9, 0.1]), rgb)
    return surfels(CENTER + radii * around, normals, width=0.012, srgb=rgb)


def ring(first_deg: float, last_deg: float, count: int = 10) -> Cameras:
    """Return two rings of cameras over a range of azimuths."""
    turns = torch.deg2rad(torch.linspace(first_deg, last_deg, count)).repeat(2)
    heights = torch.tensor([0.3, 0.9]).repeat_interleave(count)
    flat = heights.cos()
    return looking_from(CENTER + 2.5 * torch.stack([flat * turns.cos(), flat * turns.sin(), heights.sin()], 1))


def looking_from(eyes: torch.Tensor) -> Cameras:
    return pinhole(look_at(eyes, CENTER, UP), 150.0, width=120, height=90)


def photographed(whole: Gaussians, cameras: Cameras) -> Gaussians:
    """Return the part of a convex object that faces some camera."""
    normals = torch.nn.functional.normalize((whole.means - CENTER) / torch.tensor([0.25, 0.09, 0.09]), dim=1)
    towards = torch.nn.functional.normalize(cameras.centers[None] - whole.means[:, None], dim=2)
    return whole.select(((towards * normals[:, None]).sum(2) > 0.1).any(1))


def masks_of(whole: Gaussians, cameras: Cameras) -> list[torch.Tensor]:
    return [(alpha > 0.5).float() for alpha in render(whole, cameras).alpha]


def errors(found: Gaussians, whole: Gaussians, cameras: Cameras) -> float:
    return float(psnr(render(found, cameras).color, render(whole, cameras).color))


def greenest(scene: Gaussians, cameras: Cameras) -> float:
    color = render(scene, cameras).color
    return float((color[..., 1] - color[..., [0, 2]].amax(-1)).max())


@pytest.mark.parametrize("turn", [0.0, pytest.param(180.0, marks=pytest.mark.long)])
def test_the_back_of_what_was_photographed_from_one_side_is_opaque_and_has_its_colours(turn: float) -> None:
    whole, cameras, behind = egg(turn + 90), ring(turn, turn + 180), ring(turn + 220, turn + 320)
    seen = photographed(whole, cameras)
    closed = close_unseen_side(seen, cameras, masks_of(whole, cameras))
    assert torch.equal(closed.gaussians.select(~closed.is_guessed).means, seen.means)
    # of the egg's surface, beside its underside, a fifth to a third faces away from a half circle of cameras
    assert 0.1 < closed.guessed_share < 0.45
    inside = render(whole, behind).alpha > 0.9
    assert float((render(closed.gaussians, behind).alpha[inside] > 0.9).float().mean()) > 0.97
    # the missing back showed the front spot from behind
    spots = [greenest(scene, behind) for scene in (seen, closed.gaussians)]
    assert spots[0] > 0.5
    assert spots[1] < 0.1
    assert errors(closed.gaussians, whole, behind) > errors(seen, whole, behind) + 1.5
    # from the photographed side it hardly shows
    assert errors(closed.gaussians, whole, cameras) > 37


@pytest.mark.long
def test_the_back_of_what_has_two_hues_is_not_grey() -> None:
    plain, cameras = egg(90), ring(0, 180)
    is_red = (plain.means[:, :1] * 12).floor() % 2 == 0
    rgb = torch.where(is_red, torch.tensor([0.8, 0.2, 0.2]), torch.tensor([0.2, 0.2, 0.8]))
    whole = replace(plain, sh=dc_from_rgb(rgb)[:, None])
    closed = close_unseen_side(photographed(whole, cameras), cameras, masks_of(whole, cameras))
    back = rgb_from_dc(closed.gaussians.sh[closed.is_guessed, 0])
    saturation = (back - back.mean(1, keepdim=True)).norm(dim=1).median()
    # 0.49 on the seen stripes; the mean of both hues has 0.24, and a continuation of the colours alone 0.25
    assert float(saturation) > 0.4


def test_what_was_photographed_from_all_sides_stays_as_it_is() -> None:
    whole, cameras = egg(90), ring(0, 324)
    seen = photographed(whole, cameras)
    closed = close_unseen_side(seen, cameras, masks_of(whole, cameras))
    assert closed.gaussians.count == seen.count
    assert not bool(closed.is_guessed.any())
    assert closed.guessed_share == 0


@pytest.mark.long
def test_nothing_floats_where_only_a_few_photographs_reach() -> None:
    # three from above; the others' frames end below what stands between those and the object
    above = CENTER + torch.tensor([[0.1, 0.0, 2.5], [0.0, 0.1, 2.6], [-0.1, 0.0, 2.4]])
    whole, cameras = egg(90), looking_from(torch.cat([ring(0, 180).centers, above]))
    closed = close_unseen_side(photographed(whole, cameras), cameras, masks_of(whole, cameras))
    assert bool(closed.is_guessed.any())
    guessed = closed.gaussians.select(closed.is_guessed).means
    assert float(torch.cdist(guessed, whole.means).amin(1).max()) < 0.3


def test_masks_that_have_nothing_in_common_close_nothing() -> None:
    whole, cameras = egg(90), ring(0, 180)
    nothing = [torch.zeros(90, 120)] * len(cameras)
    closed = close_unseen_side(whole, cameras, nothing)
    assert closed.gaussians.count == whole.count
    assert closed.guessed_share == 0
