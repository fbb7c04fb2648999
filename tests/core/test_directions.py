"""Directions: even sets of them, and axes perpendicular to one."""

import pytest
import torch

from splatgraft.core.directions import even_directions, even_pairs, frames_along, perpendicular, tangents, vogel_offsets

# sums of three products of unit vectors' components in single precision: a few units of 2^-24
ROUNDING = 1e-6


@pytest.mark.parametrize("axis", [*even_directions(20), *torch.eye(3), *-torch.eye(3)])
def test_tangents_and_normal_are_a_right_handed_frame(axis):
    tangent, bitangent = tangents(axis)
    frame = torch.stack([tangent, bitangent, axis])
    assert torch.allclose(frame @ frame.T, torch.eye(3), rtol=0, atol=ROUNDING)
    assert torch.linalg.det(frame) > 0
    assert torch.equal(perpendicular(axis), tangent)


def test_even_directions_are_centred_unit_vectors():
    directions = even_directions(320)
    assert torch.allclose(directions.norm(dim=1), torch.ones(320), rtol=0, atol=ROUNDING)
    # a clustered set has a mean far from 0; a random one is off by 1 / sqrt(320) = 0.06
    assert directions.mean(0).norm() < 0.005


def test_even_pairs_hold_exact_opposites():
    pairs = even_pairs(32)
    assert torch.equal(pairs[:16], -pairs[16:])


def test_vogel_offsets_lie_in_the_plane_at_their_radii():
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.7]), dim=0)
    radii = torch.linspace(0.1, 1.0, 9)
    offsets = vogel_offsets(axis, radii, torch.arange(9))
    assert (offsets @ axis).abs().max() < ROUNDING
    assert torch.allclose(offsets.norm(dim=1), radii, rtol=0, atol=ROUNDING)
    first = torch.nn.functional.normalize(offsets[:2], dim=1)
    # golden angle: 137.5 degrees, cosine -0.7374
    assert abs(float(first[0] @ first[1]) + 0.73737) < 1e-5


def test_frames_look_away_from_the_light():
    directions = even_directions(50)
    frames = frames_along(directions)
    assert torch.equal(frames[:, 2], -directions)
    assert torch.allclose(frames @ frames.transpose(1, 2), torch.eye(3).expand(50, 3, 3), rtol=0, atol=ROUNDING)
