"""TranSplat's ratio: irradiance against integration over the sphere, and colours of a matt object under two lights."""

import math

import pytest
import torch
from shapes import ring, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting import SourceScene
from splatgraft.relighting.light.panorama import Panorama, cube_directions
from splatgraft_paper.benchmark.transplat import (
    irradiance_of,
    irradiance_ratio,
    project,
    relight_by_irradiance_ratio,
)


def panorama_of(radiance):
    directions, solid_angles = cube_directions(32)
    return Panorama(radiance(directions), torch.ones(6, 32, 32), directions, solid_angles)


def unit(count, seed=0):
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=1)


def test_irradiance_is_the_cosine_weighted_integral_of_the_radiance():
    def radiance(directions):
        up = directions[..., 2:]
        return torch.cat([1 + 0.5 * up, 1 - 0.3 * directions[..., :1], 0.5 + 0.4 * up**2], -1)

    panorama = panorama_of(radiance)
    normals = unit(20)
    cosine = torch.einsum("nk,fhwk->nfhw", normals, panorama.directions).clamp_min(0)
    wanted = torch.einsum("nfhw,fhwc,fhw->nc", cosine, panorama.radiance, panorama.solid_angles)
    # radiance of degree 2 is expanded exactly; both sums are over 6 x 32 x 32 pixels, good to 1/32^2
    assert torch.allclose(irradiance_of(project(panorama), normals), wanted, rtol=2e-3)


def test_an_even_sky_of_twice_the_light_doubles_every_color_and_more_is_limited():
    normals = unit(10)
    one, two = (irradiance_of(project(panorama_of(lambda d, s=s: s * torch.ones_like(d))), normals) for s in (1.0, 2.0))
    assert torch.allclose(one, torch.full_like(one, math.pi), rtol=1e-3)
    assert torch.allclose(irradiance_ratio(two, one), torch.full_like(one, 2.0), rtol=1e-4)
    assert float(irradiance_ratio(100 * two, one).max()) == 10.0


def sky(bright, dark, radius=20.0):
    """Return a shell around the origin, `bright` for y > 0 and `dark` elsewhere (sRGB)."""
    points = unit(6000, seed=1)
    color = torch.where(points[:, 1:2] > 0, torch.tensor(bright), torch.tensor(dark)).expand(-1, 3)
    return surfels(points * radius, -points, width=1.2, srgb=color)


def test_a_matt_ball_moved_under_another_sky_has_the_ratio_of_the_two_irradiances():
    normals = unit(300)
    old, new = sky(0.5, 0.5), sky(0.9, 0.3)
    ball = surfels(normals, normals, width=0.12, srgb=0.4)
    empty = torch.zeros(new.count, dtype=torch.bool)
    composite = Composite(new, (PlacedObject(ball, Similarity.identity()),), empty)
    relit, report = relight_by_irradiance_ratio(
        composite, sources=[SourceScene(old, ring(radius=6.0), normals=normals)]
    )
    assert "ratio" in report[0].text
    before, after = (linear_from_srgb(rgb_from_dc(g.sh[:, 0])) for g in (ball, relit.objects[0].gaussians))
    bright, dark, was = (float(linear_from_srgb(torch.tensor(x))) for x in (0.9, 0.3, 0.5))
    # a plane that turns by the angle a to the bright half sees (1 + cos a) / 2 of it
    share = (1 + normals[:, 1]) / 2
    wanted = before[:, 0] * (share * bright + (1 - share) * dark) / was
    # a step in the sky is cut off at degree 2: at most 5% of the sum, and the shell is drawn with gaps of some percent
    found = after.mean(1)
    assert float((srgb_from_linear(found) - srgb_from_linear(wanted)).abs().max()) < 0.05


def test_an_object_of_unknown_origin_is_pasted_and_said():
    new = sky(0.9, 0.3)
    ball = surfels(unit(50), unit(50), width=0.12)
    composite = Composite(new, (PlacedObject(ball, Similarity.identity()),), torch.zeros(new.count, dtype=torch.bool))
    relit, report = relight_by_irradiance_ratio(composite, sources=[None])
    assert torch.equal(relit.objects[0].gaussians.sh, ball.sh)
    assert "not known. It is pasted with its captured colours." in report[0].text
    with pytest.raises(ValueError, match="expected 1 source scenes, found 0"):
        relight_by_irradiance_ratio(composite, sources=[])
