"""Density control: the children of a split Gaussian."""

import torch

from splatgraft.core.gaussians import Gaussians
from splatgraft.reconstruction.density import split


def test_children_lie_on_the_long_axis_and_keep_its_variance():
    generator = torch.Generator().manual_seed(0)
    parents = Gaussians(
        means=torch.randn(50, 3, generator=generator),
        log_scales=torch.randn(50, 3, generator=generator),
        quaternions=torch.randn(50, 4, generator=generator),
        opacity_logits=torch.randn(50, generator=generator),
        sh=torch.randn(50, 4, 3, generator=generator),
    )
    children = split(parents)
    assert children.count == 100
    one, other = (children.select(torch.arange(50) + k) for k in (0, 50))
    middle, shift = (one.means + other.means) / 2, (one.means - other.means) / 2
    # float32 rounding of sums of numbers around one
    assert torch.allclose(middle, parents.means, atol=1e-5)
    rows, axis = torch.arange(50), parents.log_scales.argmax(1)
    long_axis = parents.rotations[rows, :, axis]
    variance = shift.square().sum(1) + (one.covariances @ long_axis[..., None])[..., 0].mul(long_axis).sum(1)
    assert torch.allclose(variance, parents.scales.amax(1) ** 2, rtol=1e-4)
    assert torch.equal(one.sh, parents.sh)
