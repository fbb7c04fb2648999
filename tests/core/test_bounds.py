"""The bounding sphere: holds an object, ignores stray Gaussians."""

from dataclasses import replace

import torch

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate


def shell(center, radius, *, count=1000, scale=0.01, opacity=0.9):
    """Small opaque Gaussians spread evenly over a sphere."""
    return Gaussians(
        means=even_directions(count) * radius + torch.tensor(center),
        log_scales=torch.full((count, 3), scale).log(),
        quaternions=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        opacity_logits=torch.logit(torch.full((count,), opacity)),
        sh=torch.zeros(count, 1, 3),
    )


def test_it_holds_the_object_and_its_width():
    sphere = bounding_sphere(shell((1.0, 2.0, 3.0), 2.0))
    assert torch.allclose(sphere.center, torch.tensor([1.0, 2.0, 3.0]), atol=0.05)
    # the reach is 2 + 0.01, enlarged by 5%; the centre is off by up to 0.05
    assert 2.01 <= sphere.radius <= 1.05 * (2.01 + 0.05)


def test_stray_gaussians_change_it_little():
    object_ = shell((0.0, 0.0, 0.0), 1.0)
    means = object_.means.clone()
    means[::250] = 100.0  # 4 of 1000: fewer than the 1% that may lie outside
    alone, stray = bounding_sphere(object_), bounding_sphere(replace(object_, means=means))
    # quantiles move by at most 4 ranks of 1000: 0.4% of the axis's even distribution over [-1, 1]
    assert (stray.center - alone.center).norm() < 0.01 * 3**0.5
    assert abs(stray.radius - alone.radius) < 0.02


def test_faint_gaussians_count_only_where_none_is_opaque():
    object_, haze = shell((0.0, 0.0, 0.0), 1.0), shell((0.0, 0.0, 0.0), 9.0, opacity=0.05)
    alone, both = bounding_sphere(object_), bounding_sphere(concatenate([object_, haze]))
    assert torch.equal(alone.center, both.center)
    assert alone.radius == both.radius
    assert bounding_sphere(haze).radius > 9
