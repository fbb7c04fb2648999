"""Light where captures are poor: one view, no bands, values that are not finite or huge. It stays finite."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import UP, ring, surfels

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light

PLACE = BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.3)


def room() -> Gaussians:
    """A floor in a gray shell."""
    generator = torch.Generator().manual_seed(0)
    floor = torch.cat([(torch.rand(4000, 2, generator=generator) - 0.5) * 5, torch.zeros(4000, 1)], 1)
    shell = even_directions(4000)
    return concatenate(
        [surfels(floor, UP.repeat(4000, 1), width=0.05, srgb=0.4), surfels(20 * shell, -shell, width=0.7, srgb=0.7)]
    )


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("count", [1, 12])
def test_few_views_and_no_bands_give_a_finite_light(count, degree):
    light = estimate_light(room().with_sh_degree(degree), PLACE, ring(count))
    assert isinstance(light, EstimatedLight)
    found = light.light.irradiance(even_directions(50))
    assert bool(torch.isfinite(found).all())
    # sRGB 0.7 is 0.448; the seen part of the room is that and the floor's 0.133
    assert 0.1 * math.pi < float(found.mean()) < 0.9 * math.pi


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30, -1e30])
def test_colours_that_are_not_finite_or_huge_leave_the_light_finite(value):
    scene = room()
    sh = scene.sh.clone()
    sh[::97] = value
    light = estimate_light(replace(scene, sh=sh), PLACE, ring())
    assert isinstance(light, EstimatedLight)
    found = light.light.irradiance(even_directions(50))
    assert bool(torch.isfinite(found).all())
    assert float(found.max()) < 100


@pytest.mark.parametrize("value", [math.nan, 1e30])
def test_places_that_are_not_finite_or_huge_leave_the_light_finite(value):
    scene = room()
    means = scene.means.clone()
    means[::97, 0] = value
    light = estimate_light(replace(scene, means=means), PLACE, ring())
    assert isinstance(light, EstimatedLight)
    assert bool(torch.isfinite(light.light.irradiance(even_directions(50))).all())
