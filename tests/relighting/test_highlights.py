"""The light's direction from highlights alone: on a bare glossy plane without shadows."""

import math

import pytest
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import srgb_from_linear
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.relighting.light.highlight_evidence import find_highlights
from splatgraft.relighting.light.surroundings import DIRECTIONS
from splatgraft.relighting.shading.normals import estimate_normals

UP = torch.tensor([0.0, 0.0, 1.0])
REGION = BoundingSphere(torch.zeros(3), 1.0)


def views():
    turn = torch.arange(24) / 24 * 2 * math.pi
    eyes = torch.stack([2.5 * turn.cos(), 2.5 * turn.sin(), 1.6 + 0.8 * (3 * turn).sin()], 1)
    return pinhole(look_at(eyes, torch.zeros(3), UP), 100.0, width=128, height=96)


def table(sun, gloss):
    """A plane whose harmonics of degree 3 hold a diffuse gray and a lobe of cos^16 around the mirrored `sun`."""
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([(torch.rand(3000, 2, generator=generator) - 0.5) * 2, torch.zeros(3000, 1)], 1)
    looks = even_directions(600)
    looks = looks[looks[:, 2] < 0]  # from a camera down to the plane
    mirrored = looks * torch.tensor([1.0, 1.0, -1.0])
    gray = srgb_from_linear(0.2 + gloss * (mirrored @ sun).clamp_min(0) ** 16)
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


@pytest.mark.parametrize("azimuth", [0.3, 2.4, 4.5])
def test_highlights_on_a_bare_table_give_the_direction(azimuth):
    height = math.radians(38)
    sun = torch.tensor([math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)])
    scene = table(sun, gloss=0.4)
    normals = estimate_normals(scene, views())
    highlights = find_highlights(scene, normals, views(), region=REGION)
    assert highlights is not None
    evidence = highlights.evidence()
    single = torch.eye(len(DIRECTIONS))
    explained = torch.tensor([evidence.explained(light) for light in single])
    best = DIRECTIONS[explained.argmax()]
    # directions lie 11 degrees apart; harmonics of degree 3 shift the peak of the lobe by up to 6
    assert math.degrees(math.acos(float(best @ sun))) < 12
    assert float(explained.max()) > 0.5
    # a light beside it changes the share as when it is computed anew
    both = 2 * single[explained.argmax()] + 3 * single
    more = evidence.explained_with_more(2 * single[explained.argmax()], torch.arange(len(single)), 3 * torch.ones(320))
    assert torch.allclose(more, torch.tensor([evidence.explained(light) for light in both]), atol=1e-4)


def test_a_matt_table_has_no_highlights():
    scene = table(UP, gloss=0.0)
    highlights = find_highlights(scene, estimate_normals(scene, views()), views(), region=REGION)
    # what is left is the rounding of float32
    assert highlights is None or float(highlights.change.abs().max()) < 1e-5


def test_flat_colours_have_no_highlights():
    scene = table(UP, gloss=0.4).with_sh_degree(0)
    normals = estimate_normals(scene, views())
    assert find_highlights(scene, normals, views(), region=REGION) is None
