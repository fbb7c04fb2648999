"""Evidence and density of the light, in closed form: near lights, and windows beside their reflections."""

import math

import pytest
import torch

from splatgraft.core.bounds import BoundingSphere
from splatgraft.relighting.light.evidence import ShadingEvidence
from splatgraft.relighting.light.panorama import DIRECTIONS, Surroundings, nearest_directions
from splatgraft.relighting.light.radiance_model import LightEvidence, radiance_problem

UP = torch.tensor([0.0, 0.0, 1.0])
COUNT = len(DIRECTIONS)


def receivers(points: torch.Tensor, visibility: torch.Tensor | None = None) -> ShadingEvidence:
    """Gray, level surfaces."""
    n = len(points)
    return ShadingEvidence(
        region=BoundingSphere(torch.zeros(3), 1.0),
        points=points,
        normals=UP.repeat(n, 1),
        visibility=torch.ones(n, COUNT) if visibility is None else visibility,
        colors=torch.full((n, 3), 0.2),
        weights=torch.full((n,), 1 / n),
        material=torch.zeros(n, dtype=torch.int64),
    )


def surroundings(clipped: torch.Tensor) -> Surroundings:
    """All seen, gray but for what is clipped, and far away."""
    radiance = torch.where(clipped > 0, 1.0, 0.3)[:, None].repeat(1, 3)
    return Surroundings(radiance, torch.ones(COUNT), clipped, DIRECTIONS, torch.full((COUNT,), 1e4))


def test_a_light_twice_as_far_as_the_region_is_wide_shines_from_where_it_stands():
    towards = torch.tensor([math.cos(math.radians(40)), 0.0, math.sin(math.radians(40))])
    k = int(nearest_directions(towards[None]))
    distances = torch.full((COUNT,), math.inf)
    distances[k] = 2.0
    points = torch.tensor([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [-0.8, 0.0, 0.0]])
    found = receivers(points).transport(distances)[:, k]
    # a small patch that faces the middle: both cosines over the square of the distance
    light = 2 * DIRECTIONS[k].double()
    away = light - points.double()
    apart = away.norm(dim=1)
    expected = away[:, 2] * (away @ DIRECTIONS[k].double()) / apart**4
    # rows are scaled to sum to 1, and one of 320 directions changes that by a percent
    assert (found / found[0]).tolist() == pytest.approx((expected / expected[0]).tolist(), rel=0.02)
    assert float(found[1] / found[0]) > 1.5


def test_surroundings_at_infinity_are_seen_alike_from_everywhere():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20, 3, generator=generator) - 0.5
    evidence = receivers(points, torch.rand(20, COUNT, generator=generator))
    far = evidence.transport(torch.full((COUNT,), math.inf))
    # infinity counts as 10,000 units: float32 of directions
    assert torch.allclose(far, evidence.transport(), atol=1e-5)
    assert torch.allclose(receivers(points).transport().sum(1), torch.ones(20))


def test_a_window_above_its_reflection_on_a_table_may_be_a_source():
    azimuth = torch.atan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]).abs()
    height = torch.rad2deg(torch.asin(DIRECTIONS[:, 2]))
    window = (azimuth < 0.4) & (height > -5) & (height < 20)
    reflection = (azimuth < 0.4) & (height < -5) & (height > -60)
    around = surroundings((window | reflection).float())
    surfaces = receivers(torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    problem = radiance_problem(LightEvidence(surfaces, None, around, around, UP))
    (patch,) = problem.patches
    members = problem.clipped[patch.members]
    assert set(window.nonzero()[:, 0].tolist()) <= set(members.tolist())
    assert float(height[members].min()) > -8.1
