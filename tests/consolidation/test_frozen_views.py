"""Frozen views: equal to the renderer, cropped cameras, transposes, and the budget of the cache."""

from dataclasses import replace

import pytest
import torch
from ball_scenes import ball, basis_towards, ring, views_of
from hypothesis import given, settings
from hypothesis import strategies as st

from splatgraft.fitting import adam
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.lazy_sequence import LazySequence

BLACK = LazySequence(6, lambda index: torch.zeros(40, 40, 3))


def test_render_equals_the_renderer_with_and_without_a_subset():
    scene, cameras = ball(200, degree=2, seed=1), ring(3, 40)
    rendering = RenderOptions(background=(0.2, 0.4, 0.6))
    wanted = render(scene, cameras, options=rendering).color
    views = views_of(scene, cameras, BLACK, rendering=rendering)
    active = torch.arange(200) % 3 == 0
    part = views.restricted(active, [(0, 0, 40, 40)] * 3)
    for index in range(3):
        # sums of at most some 50 float32 terms of size 1 in another order
        assert torch.allclose(views[index].render(scene.sh), wanted[index], atol=1e-5)
        assert torch.allclose(part[index].render(scene.sh[active]), wanted[index], atol=1e-5)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**16))
def test_blend_transpose_is_the_transpose_of_blend(seed):
    scene, cameras = ball(100, degree=1, seed=seed), ring(2, 40)
    active = torch.arange(100) % 2 == 0
    view = views_of(scene, cameras, BLACK).restricted(active, [(0, 0, 40, 40)] * 2)[1]
    generator = torch.Generator().manual_seed(seed)
    colors, image = torch.rand(50, 3, generator=generator), torch.rand(40, 40, 3, generator=generator)
    left, right = (view.blend(colors) * image).sum(), (colors * view.blend_transpose(image)).sum()
    # about 5000 positive float32 products summed in two orders
    assert torch.allclose(left, right, rtol=1e-4)


def test_a_cropped_camera_sees_a_cut_of_the_picture():
    scene, cameras = ball(200, degree=1, seed=2), ring(2, 40)
    whole = render(scene, cameras).color
    windows = [(3, 5, 30, 36), (0, 10, 17, 40)]
    cut = cameras.cropped(windows)
    for index, (left, top, right, bottom) in enumerate(windows):
        # positions shift by whole pixels; float32 rounding of coordinates near 40 px over splats of 1 px and more,
        # and the renderer's own cut-offs at alpha 1/255
        got = render(scene, cut[index]).color[0]
        assert torch.allclose(got, whole[index, top:bottom, left:right], atol=1 / 255)
        assert float((got - whole[index, top:bottom, left:right]).abs().mean()) < 1e-4


def test_the_budget_bounds_what_is_kept():
    scene, cameras = ball(300, degree=2, seed=3), ring(6, 40)
    one = views_of(scene, cameras, BLACK)[0].own_bytes
    assert one > 40 * 40 * 4  # opacity of every pixel
    views = views_of(scene, cameras, BLACK, cache_bytes=int(2.5 * one))
    kept = [views[index] is views[index] for index in range(6)]
    assert 1 <= sum(kept) <= 3
    assert views_of(scene, cameras, BLACK, cache_bytes=0)[0] is not None


def test_a_fused_step_of_descent_is_adam_on_the_transpose():
    scene, cameras = ball(150, degree=2, seed=9), ring(2, 40)
    views, generator = views_of(scene, cameras, BLACK), torch.Generator().manual_seed(10)
    rates = torch.rand(27, generator=generator)
    fused, plain = scene.sh.clone(), scene.sh.clone()
    of_fused, of_plain = (adam.no_moments({"sh": fused}, 150) for _ in range(2))
    for turn in range(4):
        view, colors = views[turn % 2], torch.randn(150, 3, generator=generator)
        if turn == 3:
            colors[int(torch.nonzero(view.visible)[0]), 1] = torch.nan
        gradient = torch.zeros_like(plain)
        view.expansion.add_transpose(colors, gradient)
        of = {"moments": of_plain, "visible": view.visible, "rates": {"sh": rates}}
        finite = adam.step({"sh": plain}, {"sh": gradient}, **of)
        assert view.expansion.descend(fused, colors, moments=of_fused, rates=rates) == finite == (turn < 3)
    # the same operations, compiled twice
    assert torch.allclose(fused, plain, atol=1e-6)
    assert torch.equal(of_fused.steps, of_plain.steps)
    assert torch.allclose(of_fused.second["sh"], of_plain.second["sh"], rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 3])
def test_an_expansion_and_its_transposes_are_products_with_the_basis(degree):
    scene, cameras = ball(150, degree=degree, seed=8), ring(1, 40)
    scene = replace(scene, means=torch.cat([scene.means[:140], scene.means[140:] + 50]))
    view = views_of(scene, cameras, BLACK)[0]
    generator = torch.Generator().manual_seed(degree)
    basis = basis_towards(scene, cameras) * view.visible[:, None]
    assert not bool(view.visible[140:].any())
    colors, weights = torch.randn(150, 3, generator=generator), torch.rand(150, 1, generator=generator)
    # float32 sums of at most 16 terms of size 1
    assert torch.allclose(view.expansion.colors(scene.sh), torch.einsum("mk,mkc->mc", basis, scene.sh), atol=1e-5)
    added = torch.ones_like(scene.sh)
    view.expansion.add_transpose(colors, added)
    assert torch.allclose(added, 1 + basis[:, :, None] * colors[:, None, :], atol=1e-5)
    squares = torch.zeros(150, basis.shape[1], basis.shape[1])
    view.expansion.add_squares(weights, squares)
    assert torch.allclose(squares, (weights * basis)[:, :, None] * basis[:, None, :], atol=1e-5)
