"""Density control: the children of a split Gaussian, and which Gaussian is split."""

import torch
from shapes import blobs, random_scene

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.fitting.adam import no_moments
from splatgraft.fitting.density import DensityControl, split
from splatgraft.fitting.gaussian_fit import FitState, Step, ViewColors
from splatgraft.rendering import RenderOptions


def test_children_lie_on_the_long_axis_and_keep_its_variance():
    parents = random_scene(50, 1, seed=0)
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


def split_parents(error_every: int) -> list[float]:
    """Return x of the unsplit Gaussians: three side by side of equal gradients, but the left one has a
    tenth more; the residual lies under the right one."""
    gaussians = blobs(torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]]), 0.135, opacity_logit=2.0)
    pose = look_at(torch.tensor([[0.0, -4, 0]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
    camera = pinhole(pose, 48.0, width=48, height=32)
    residual = torch.zeros(32, 48, 3)
    residual[:, 30:] = -0.2
    gradients = {"means": torch.tensor([[1.1, 0, 0], [1, 0, 0], [1, 0, 0]])}
    seen = torch.ones(3, dtype=torch.bool)
    step = Step(camera, seen, gradients, residual, RenderOptions())
    state = FitState(10, gaussians, no_moments({"means": gaussians.means}, 3), ViewColors.start(torch.ones(1)))
    control = DensityControl(4, 3, 10, 10, 20, camera.centers, error_every=error_every)
    return control.update(state, step).gaussians.means[:2, 0].tolist()


def test_the_gaussian_that_covers_an_error_is_split_before_one_of_a_larger_gradient():
    assert split_parents(error_every=0) == [0, 1]
    assert split_parents(error_every=1) == [-1, 0]
