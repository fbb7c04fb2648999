"""One gain per channel: it equals the ratio of known lights, stays within its limits, and is applied exactly."""

import math

import pytest
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.relighting.gain import local_gain, mean_light
from splatgraft.relighting.light.panorama import Panorama, cube_directions
from splatgraft.relighting.shading import apply_gain

UP = torch.tensor([0.0, 0.0, 1.0])


def panorama(radiance, alpha=None, size=16):
    directions, area = cube_directions(size)
    alpha = torch.ones(6, size, size) if alpha is None else alpha
    radiance = torch.as_tensor(radiance).expand(6, size, size, 3)
    return Panorama(radiance=radiance, alpha=alpha, directions=directions, solid_angles=area)


def random_gaussians(n=40, k=16, seed=0):
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        log_scales=torch.randn(n, 3, generator=g),
        quaternions=torch.randn(n, 4, generator=g),
        opacity_logits=torch.randn(n, generator=g),
        sh=torch.randn(n, k, 3, generator=g) * 0.05,
    )


def test_uniform_light_gives_the_ratio_of_radiances():
    found = local_gain(
        panorama([0.4, 0.4, 0.4]), panorama([0.6, 0.4, 0.3]), source_up=UP, target_up=torch.tensor([0.0, 1, 0])
    )
    # float32 sums over 1536 pixels
    assert torch.allclose(found.gain, torch.tensor([1.5, 1.0, 0.75]), atol=1e-4)
    assert not found.held_back
    assert found.source_coverage == pytest.approx(1, abs=1e-5)


def test_light_from_above_counts_and_from_straight_below_hardly():
    directions, _ = cube_directions(32)
    bright = torch.ones(6, 32, 32, 3)
    above = panorama(bright * (directions[..., 2:] > 0.8), size=32)
    below = panorama(bright * (directions[..., 2:] < -0.8), size=32)
    up_light, down_light = mean_light(above, UP)[0], mean_light(below, UP)[0]
    # caps of equal size: weights (1 + z)/2 average 0.95 and 0.05
    assert torch.allclose(up_light / down_light, torch.full((3,), 19.0), rtol=0.15)  # the cap's edge in pixels


def test_same_light_changes_no_bit():
    place = panorama([0.3, 0.5, 0.2])
    found = local_gain(place, place, source_up=UP, target_up=UP)
    assert torch.equal(found.gain, torch.ones(3))
    object_ = random_gaussians()
    assert torch.equal(apply_gain(object_, found.gain).sh, object_.sh)


def test_gains_beyond_the_limits_are_held_back_and_reported():
    found = local_gain(panorama([0.01, 0.01, 0.01]), panorama([0.9, 0.9, 0.9]), source_up=UP, target_up=UP)
    assert torch.allclose(found.gain, torch.full((3,), 4.0))
    assert found.held_back
    assert "held back" in found.describe()
    tinted = local_gain(panorama([0.1, 0.1, 0.1]), panorama([0.1, 0.1, 0.001]), source_up=UP, target_up=UP)
    spread = tinted.gain.log() - tinted.gain.log().mean()
    assert spread.abs().max() < 2 * math.log(1.6)


def test_an_empty_panorama_changes_nothing():
    nothing = panorama([0.0, 0.0, 0.0], alpha=torch.zeros(6, 16, 16))
    found = local_gain(nothing, panorama([0.5, 0.5, 0.5]), source_up=UP, target_up=UP)
    assert torch.equal(found.gain, torch.ones(3))
    assert found.held_back
    assert found.source_coverage == 0


def test_gain_multiplies_linear_light_of_the_mean_colour():
    object_, gain = random_gaussians(), torch.tensor([1.4, 0.8, 0.5])
    before = linear_from_srgb(spherical_harmonics.rgb_from_dc(object_.sh[:, 0]))
    after = linear_from_srgb(spherical_harmonics.rgb_from_dc(apply_gain(object_, gain).sh[:, 0]))
    assert torch.allclose(after, before * gain, atol=1e-5)  # float32 powers there and back


def test_higher_bands_follow_to_first_order():
    object_, gain = random_gaussians(), torch.tensor([1.4, 0.8, 0.5])
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    exact = srgb_from_linear(linear_from_srgb(spherical_harmonics.colors(object_.sh, directions)) * gain)
    found = spherical_harmonics.colors(apply_gain(object_, gain).sh, directions)
    # deviations are about 0.05 * 1.1 = 0.06 rms, 0.2 at most; the curve's second derivative is under 1 for these gains
    assert (found - exact).abs().max() < 0.5 * 0.2**2
    assert (found - exact).abs().mean() < 0.5 * 0.06**2
