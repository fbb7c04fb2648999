"""The light's direction from highlights alone: on a bare glossy plane without shadows."""

import math
from dataclasses import replace

import pytest
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import srgb_from_linear
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.relighting.light.evidence import find_highlights
from splatgraft.relighting.light.panorama import DIRECTIONS
from splatgraft.relighting.normals import estimate_normals

UP = torch.tensor([0.0, 0.0, 1.0])
REGION = BoundingSphere(torch.zeros(3), 1.0)


def views():
    turn = torch.arange(24) / 24 * 2 * math.pi
    eyes = torch.stack([2.5 * turn.cos(), 2.5 * turn.sin(), 1.6 + 0.8 * (3 * turn).sin()], 1)
    return pinhole(look_at(eyes, torch.zeros(3), UP), 100.0, width=128, height=96)


def polished(looks, sun):
    """A lobe of cos^16 around the mirrored sun, for unit directions from a camera down to the plane."""
    return ((looks * torch.tensor([1.0, 1.0, -1.0])) @ sun).clamp_min(0) ** 16


def rough(looks, sun):
    """Light that a rough dielectric reflects: GGX of alpha .5 with Smith's masking of both sides and Fresnel."""
    alpha, view = 0.5, -looks
    half = torch.nn.functional.normalize(view + sun, dim=1)
    spread = alpha**2 / (math.pi * (half[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)

    def shadow(cosine):  # height-correlated, as in Heitz 2014
        return 0.5 * (torch.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)) - 1)

    masking = 1 / (1 + shadow(view[:, 2]) + shadow(sun[2]))
    fresnel = 0.04 + 0.96 * (1 - (half * view).sum(1)) ** 5
    return spread * masking * fresnel / (4 * view[:, 2])


def table(sun, gloss, reflected=polished):
    """A plane whose harmonics of degree 3 hold a diffuse gray and what it reflects of `sun`."""
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([(torch.rand(3000, 2, generator=generator) - 0.5) * 2, torch.zeros(3000, 1)], 1)
    looks = even_directions(600)
    looks = looks[looks[:, 2] < -0.1]  # from a camera down to the plane
    gray = srgb_from_linear(0.2 + gloss * reflected(looks, sun))
    sh = torch.linalg.lstsq(spherical_harmonics.basis(looks, 3), (gray - 0.5)[:, None]).solution
    n = len(points)
    normals = UP.repeat(n, 1)
    return Gaussians(
        means=points,
        log_scales=torch.tensor([0.04, 0.04, 0.004]).log().repeat(n, 1),
        quaternions=quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        opacity_logits=torch.full((n,), 3.0),
        sh=sh[None].repeat(n, 1, 3),
    )


def towards(height_deg, azimuth):
    height = math.radians(height_deg)
    return torch.tensor([math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)])


def evidence_of(scene):
    evidence = find_highlights(scene, estimate_normals(scene, views()), views(), region=REGION)
    assert evidence is not None
    return evidence


def explained_by_each(evidence):
    k = len(DIRECTIONS)
    return evidence.explained_with_more(torch.zeros(k), torch.arange(k), torch.ones(k))


@pytest.mark.parametrize("azimuth", [0.3, 2.4, 4.5])
def test_highlights_on_a_bare_table_give_the_direction(azimuth):
    sun = towards(38, azimuth)
    evidence = evidence_of(table(sun, gloss=0.4))
    single = torch.eye(len(DIRECTIONS))
    explained = explained_by_each(evidence)
    best = DIRECTIONS[explained.argmax()]
    # directions lie 11 degrees apart; harmonics of degree 3 shift the peak of the lobe by up to 6
    assert math.degrees(math.acos(float(best @ sun))) < 12
    assert float(explained.max()) > 0.5
    assert float(explained[7]) == pytest.approx(evidence.explained(single[7]), abs=1e-4)
    # a light beside it changes the share as when it is computed anew
    index = torch.arange(0, len(single), 20)
    both = 2 * single[explained.argmax()] + 3 * single[index]
    more = evidence.explained_with_more(2 * single[explained.argmax()], index, 3 * torch.ones(len(index)))
    assert torch.allclose(more, torch.tensor([evidence.explained(light) for light in both]), atol=1e-4)


def test_a_rough_table_gives_the_height_of_a_sun_though_it_is_brightest_at_flat_views():
    """Along the mirrored direction alone the sun is found 14 degrees too low."""
    sun = towards(50, 1.0)
    best = DIRECTIONS[explained_by_each(evidence_of(table(sun, gloss=0.6, reflected=rough))).argmax()]
    assert math.degrees(math.acos(float(best @ sun))) < 12


def test_each_material_has_its_own_gloss():
    """One gloss for all explains what the glossy half shows by half, as the matt half denies it."""
    sun = towards(38, 1.0)
    glossy = table(sun, 0.4).select(torch.arange(1500))
    matt = table(sun, 0.0).select(torch.arange(1500, 3000))
    less_red = matt.sh.clone()
    less_red[:, 0, 0] -= 0.15 / 0.2820948
    matt = replace(matt, sh=less_red)
    whole = explained_by_each(evidence_of(table(sun, 0.4))).max()
    assert float(explained_by_each(evidence_of(concatenate([glossy, matt]))).max()) > 0.9 * float(whole)


def test_a_matt_table_has_no_highlights():
    scene = table(UP, gloss=0.0)
    evidence = find_highlights(scene, estimate_normals(scene, views()), views(), region=REGION)
    # what is left is the rounding of float32, 1e-5
    assert evidence is None or evidence.variance < 1e-10


def test_flat_colours_have_no_highlights():
    scene = table(UP, gloss=0.4).with_sh_degree(0)
    normals = estimate_normals(scene, views())
    assert find_highlights(scene, normals, views(), region=REGION) is None
