"""The operator of one view: linear, equal to the renderer, and with its adjoint as transpose."""

from dataclasses import replace

import pytest
import torch
from shapes import camera_inside as camera
from shapes import random_scene

from splatgraft import rendering
from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import empty
from splatgraft.rendering import RenderOptions, ViewOperator


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("low_pass", ["classic", "antialiased"])
def test_transpose_is_the_adjoint(channels, low_pass):
    operator = rendering.view_operator(random_scene(400, 0, seed=1), camera(100, 70), RenderOptions(low_pass=low_pass))
    generator = torch.Generator().manual_seed(2)
    values = torch.randn(400, channels, generator=generator)
    image = torch.randn(70, 100, channels, generator=generator)
    left = (operator.blend(values).double() * image).sum()
    right = (operator.blend_transpose(image).double() * values).sum()
    # float32 sums of some 1e5 products of order one, which cancel
    scale = operator.blend(values).norm() * image.norm()
    assert abs(left - right) < 1e-6 * scale


def test_blending_colours_is_rendering():
    scene, view = random_scene(200, 2, seed=3), camera()
    operator = rendering.view_operator(scene, view)
    directions = torch.nn.functional.normalize(scene.means - view.centers[0], dim=-1)
    colors = spherical_harmonics.colors(scene.sh, directions)
    picture = rendering.render(scene, view)
    # float32 colours of a few units, made by two routines
    assert (operator.blend(colors) - picture.color[0]).abs().max() < 1e-5
    assert (operator.alpha - picture.alpha[0]).abs().max() < 1e-6
    # the renderer's `visible` includes Gaussians that the early stop and the last pixel test omit
    assert not (operator.visible & ~picture.visible[0]).any()
    assert torch.equal(operator.visible, (operator.blend_transpose(torch.ones(29, 37, 1)) > 0)[:, 0])
    assert isinstance(operator, ViewOperator)


@pytest.mark.parametrize("channels", [1, 3])
def test_blending_ones_gives_alpha_and_gradient_is_the_transpose(channels):
    operator = rendering.view_operator(random_scene(200, 0, seed=4), camera())
    values = torch.ones(200, channels, requires_grad=True)
    image = operator.blend(values)
    # sums of weights up to 1 in float32
    assert (image - operator.alpha[..., None]).abs().max() < 1e-5
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(5))
    image.backward(weights)
    assert torch.equal(values.grad, operator.blend_transpose(weights))
    assert not values.grad[~operator.visible].any()


def test_nothing_to_see():
    operator = rendering.view_operator(empty(), camera())
    assert not operator.alpha.any()
    assert not operator.blend(torch.zeros(0, 3)).any()
    assert operator.blend_transpose(torch.ones(29, 37, 3)).shape == (0, 3)


def test_blending_and_transposing_at_once_equals_one_after_the_other():
    operator = rendering.view_operator(random_scene(400, 0, seed=6), camera(100, 70))
    values = torch.randn(400, 3, generator=torch.Generator().manual_seed(7))
    # the same products in the same order
    assert torch.equal(operator.blend_and_transpose(values), operator.blend_transpose(operator.blend(values)))


def test_rows_of_no_weight_are_left_out_of_the_map_and_of_its_transpose():
    scene = random_scene(4000, 0, seed=10)
    scene = replace(scene, opacity_logits=scene.opacity_logits + 3)  # most are behind others
    exact = rendering.view_operator(scene, camera(100, 70))
    operator = rendering.view_operator(scene, camera(100, 70), min_row_weight=1e-4)
    generator = torch.Generator().manual_seed(11)
    values, image = torch.rand(4000, 3, generator=generator), torch.randn(70, 100, 3, generator=generator)
    assert 0 < operator.visible.sum() < exact.visible.sum()
    assert not (operator.visible & ~exact.visible).any()
    # 16 rows in each of 35 tiles
    weights = exact.blend_transpose(torch.ones(70, 100, 1))[~operator.visible]
    assert weights.max() < 16 * 35 * 1e-4
    # a pixel loses at most 1e-4 of each of some 100 Gaussians of its tile, and gains as much of those behind
    assert (operator.blend(values) - exact.blend(values)).abs().max() < 5e-3
    left = (operator.blend(values).double() * image).sum()
    right = (operator.blend_transpose(image).double() * values).sum()
    # float32 sums, which cancel
    assert abs(left - right) < 1e-6 * operator.blend(values).norm() * image.norm()
    # the same products in the same order
    both = operator.blend_transpose(operator.blend(values))
    assert torch.equal(operator.blend_and_transpose(values), both)
    assert torch.allclose(operator.blend(torch.ones(4000, 1))[..., 0], operator.alpha, atol=1e-5)


def test_the_transposed_residual_equals_one_after_the_other():
    operator = rendering.view_operator(random_scene(400, 0, seed=8), camera(100, 70))
    generator = torch.Generator().manual_seed(9)
    values, target = torch.randn(400, generator=generator), torch.randn(70, 100, generator=generator)
    picture = operator.blend(values[:, None])[..., 0]
    target[:32] = picture[:32]  # tiles without any error
    wanted = operator.blend_transpose((target - picture)[..., None])[:, 0]
    # the same float32 products, summed over rows in another order
    assert torch.allclose(operator.transpose_residual(values, target), wanted, atol=1e-5)
