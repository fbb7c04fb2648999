"""The gain of exposure and white balance: the mean light at a place, its limits, and objects between uniform rooms."""

import math

import pytest
import torch
from shapes import UP, blobs, ring, same_bits

from splatgraft.composition import compose
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import empty
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting import SourceScene
from splatgraft.relighting.light.panorama import Panorama, cube_directions
from splatgraft_paper.benchmark.gain import local_gain, mean_light, relight_by_gain


def panorama(radiance, alpha=None, size=16):
    directions, area = cube_directions(size)
    alpha = torch.ones(6, size, size) if alpha is None else alpha
    radiance = torch.as_tensor(radiance).expand(6, size, size, 3)
    return Panorama(radiance=radiance, alpha=alpha, directions=directions, solid_angles=area)


def test_light_from_above_counts_and_from_straight_below_hardly():
    directions, _ = cube_directions(32)
    bright = torch.ones(6, 32, 32, 3)
    above = panorama(bright * (directions[..., 2:] > 0.8), size=32)
    below = panorama(bright * (directions[..., 2:] < -0.8), size=32)
    up_light, down_light = mean_light(above, UP)[0], mean_light(below, UP)[0]
    # caps of equal size: weights (1 + z)/2 average 0.95 and 0.05
    assert torch.allclose(up_light / down_light, torch.full((3,), 19.0), rtol=0.15)  # the cap's edge in pixels


def test_gains_beyond_the_limits_are_held_back_and_reported():
    found = local_gain(panorama([0.01, 0.01, 0.01]), panorama([0.9, 0.9, 0.9]), source_up=UP, target_up=UP)
    assert torch.allclose(found.gain, torch.full((3,), 4.0))
    assert found.held_back
    tinted = local_gain(panorama([0.1, 0.1, 0.1]), panorama([0.1, 0.1, 0.001]), source_up=UP, target_up=UP)
    spread = tinted.gain.log() - tinted.gain.log().mean()
    assert spread.abs().max() < 2 * math.log(1.6)


def room(color, *, n=2500, radius=2.0, spread=0.12):
    return blobs(radius * even_directions(n), spread, srgb=torch.tensor(color), opacity_logit=8.0)


def cameras():
    return ring(4, height=0.5, radius=1.5, size=(64, 48))


MOVE = Similarity(
    scale=1.0,
    rotation=rotation_from_quaternion(torch.tensor([[0.9, 0.0, 0.0, 0.4]]))[0],
    translation=torch.tensor([0.2, 0.1, 0.0]),
)


def test_the_ratio_of_two_uniform_rooms_is_put_on_the_object():
    light = torch.tensor([1.5, 1.0, 0.8])
    source_color = torch.tensor([0.5, 0.5, 0.5])
    target_color = srgb_from_linear(linear_from_srgb(source_color) * light)
    thing = room([0.4, 0.5, 0.6], n=200, radius=0.1, spread=0.02)
    composite = compose(room(target_color.tolist()), [thing], target_from_objects=[MOVE])
    source = SourceScene(room(source_color.tolist()), cameras())
    relit, report = relight_by_gain(composite, cameras(), sources=[source])
    before, after = (linear_from_srgb(rgb_from_dc(c.objects[0].gaussians.sh[:, 0])) for c in (composite, relit))
    # uniform shells give their colour in every pixel; opacity of 0.9997 and coverage of over 0.99 leave 1%
    assert torch.allclose(after / before, light.expand(200, 3), rtol=0.01)
    assert "Exposure and white balance" in report[0].text
    assert torch.equal(relit.target.sh, composite.target.sh)


@pytest.mark.parametrize("scene", [empty(), None])
def test_an_unknown_or_empty_source_changes_no_bit(scene):
    thing = room([0.4, 0.5, 0.6], n=200, radius=0.1, spread=0.02)
    composite = compose(room([0.5, 0.5, 0.5]), [thing, empty()], target_from_objects=[MOVE, MOVE])
    source = None if scene is None else SourceScene(scene, cameras())
    relit, report = relight_by_gain(composite, cameras(), sources=[source, None])
    assert same_bits(composite.objects[0].gaussians, relit.objects[0].gaussians)
    assert all("pasted as it is" in note.text and note.in_doubt for note in report)
