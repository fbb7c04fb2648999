"""The shade of things that a capture does not show, on level ground with a round patch of another colour."""

import pytest
import torch
from shapes import UP, ring, surfels
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.gaussians import concatenate
from splatgraft.core.images import srgb_from_linear
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.known_sun import OpenGround, clear_ratio
from splatgraft.relighting.light.sun import UNSEEN_RADIUS_DEG, Sun

SUN = torch.nn.functional.normalize(torch.tensor([0.3, -0.3, 0.9]), dim=0)
REGION = BoundingSphere(torch.tensor([0.0, 0.0, 0.15]), 2.4)
IN_PATCH, BESIDE = (BoundingSphere(torch.tensor([x, 0.0, 0.15]), 0.2) for x in (-0.8, 1.2))
GRASS = torch.tensor([0.05, 0.06, 0.04])
SUNLIT = GRASS * (1 + clear_ratio(float(SUN @ UP)))


def ground(patch: Tensor, others: Tensor, *, with_blocker: bool = False) -> OpenGround:
    """The ground in linear colours; a blocker above the views casts its shadow on the patch."""
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(12000, 2, generator=generator) - 0.5) * 5
    points = torch.cat([points, torch.zeros(len(points), 1)], 1)
    is_patch = (points - IN_PATCH.center)[:, :2].norm(dim=1, keepdim=True) < 0.7
    colors = torch.where(is_patch, patch, others) * (0.1 * torch.randn(len(points), 1, generator=generator)).exp()
    scene = surfels(points, UP.expand_as(points), srgb=srgb_from_linear(colors.clamp(0, 1)), width=0.05)
    if with_blocker:
        blocker = points[is_patch[:, 0]] + 2.2 * SUN / SUN[2]
        scene = concatenate([scene, surfels(blocker, UP.expand_as(blocker), width=0.1)])
    sun = Sun(SUN, UNSEEN_RADIUS_DEG, UP, None, 0.0)
    return OpenGround.around(CapturedScene(scene, ring()), REGION, sun)


def test_a_place_is_shaded_where_the_same_ground_beside_it_is_sunlit():
    shown = ground(GRASS, SUNLIT)
    assert shown.is_shaded(IN_PATCH)
    assert not shown.is_shaded(BESIDE)


@pytest.mark.parametrize(
    ("patch", "others"),
    [
        pytest.param(GRASS, GRASS, id="shade everywhere"),
        pytest.param(SUNLIT, SUNLIT, id="sun everywhere"),
        pytest.param(SUNLIT, GRASS, id="in the only sun"),
        pytest.param(0.12 * SUNLIT, SUNLIT, id="darker ground in the sun"),
        pytest.param(GRASS, SUNLIT.flip(0), id="brighter and bluer ground"),
        pytest.param(GRASS, SUNLIT * torch.tensor([1.0, 1.3, 1.0]), id="greener ground in the sun"),
    ],
)
def test_a_place_is_not_shaded_without_sunlit_ground_of_its_material(patch, others):
    assert not ground(patch, others).is_shaded(IN_PATCH)


def test_the_shade_of_a_captured_thing_is_left_to_the_shadow_maps():
    shown = ground(GRASS, SUNLIT, with_blocker=True)
    assert len(shown.points) > 1000
    assert not shown.is_shaded(IN_PATCH)
