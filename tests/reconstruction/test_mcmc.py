"""3DGS-MCMC's density control: what copies share, where they come from, and noise."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting import FitState, Step
from splatgraft.fitting.adam import no_moments
from splatgraft.fitting.view_colors import ViewColors
from splatgraft.reconstruction.mcmc import McmcControl, McmcOptions, shared_by
from splatgraft.rendering import RenderOptions, render

POSE = look_at(torch.tensor([[0.0, -4, 0]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
CAMERA = pinhole(POSE, 96.0, width=64, height=64)


def some_gaussians(count: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=0.5 * torch.randn(count, 3, generator=generator),
        log_scales=-2 + 0.3 * torch.randn(count, 3, generator=generator),
        quaternions=torch.randn(count, 4, generator=generator),
        opacity_logits=torch.randn(count, generator=generator),
        sh=torch.randn(count, 1, 3, generator=generator),
    )


def updated(gaussians: Gaussians, control: McmcControl, *, iteration: int, rate: float = 0.0) -> FitState:
    moments = no_moments({"means": gaussians.means}, gaussians.count)
    moments.first["means"][:] = 1.0
    moments.steps[:] = 7
    seen = torch.ones(gaussians.count, dtype=torch.bool)
    step = Step(CAMERA, seen, {}, rate, torch.zeros(64, 64, 3), RenderOptions())
    state = FitState(iteration, gaussians, moments, ViewColors.identity(1, torch.device("cpu")))
    return control.update(state, step)


def equation_9(opacity: float, count: int) -> tuple[float, float]:
    """New opacity and factor on the scales, as the paper writes them, in numpy's double precision."""
    each = 1 - (1 - opacity) ** (1 / count)
    total = np.float64(0)
    for i in range(1, count + 1):
        for k in range(i):
            total += math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / np.sqrt(k + 1)
    return each, opacity / total


@pytest.mark.parametrize("count", [1, 2, 3, 10, 51])
def test_copies_share_as_equation_9_says(count: int) -> None:
    for opacity in (0.03, 0.5, 0.9, 0.999):
        opacities, factors = shared_by(torch.tensor([opacity]), torch.tensor([count]), McmcOptions(dead_opacity=1e-6))
        each, factor = equation_9(opacity, count)
        assert float(opacities) == pytest.approx(each, rel=1e-4)
        assert float(factors) == pytest.approx(factor, rel=1e-4)


def test_copies_draw_together_what_one_drew() -> None:
    # wide, so that the renderer's low pass changes little
    wide = torch.full((1, 3), -1.3)
    one = replace(some_gaussians(1), means=torch.zeros(1, 3), opacity_logits=torch.tensor([1.5]), log_scales=wide)
    opacities, factors = shared_by(one.opacities, torch.tensor([4]))
    child = replace(one, opacity_logits=opacities.logit(), log_scales=one.log_scales + factors.log())
    four = child.select(torch.zeros(4, dtype=torch.long))
    before, after = (render(scene, CAMERA).alpha[0] for scene in (one, four))
    # Eq. 9 keeps the value in the middle and the integral along a line through it, not every pixel
    assert float((before - after).abs().max()) < 0.06
    for row, same in ((before[31:33], after[31:33]), (before[:, 31:33], after[:, 31:33])):
        assert float(same.sum()) == pytest.approx(float(row.sum()), rel=0.015)
    assert float(after.max()) == pytest.approx(float(before.max()), rel=0.01)


def test_transparent_gaussians_move_to_opaque_ones_and_copies_are_added_up_to_the_budget() -> None:
    gaussians = some_gaussians(100)
    logits = gaussians.opacity_logits.clone()
    logits[:30] = -8.0
    gaussians = replace(gaussians, opacity_logits=logits)
    control = McmcControl(budget=103, start=10, stop=1000, every=10)
    early = updated(gaussians, control, iteration=10).gaussians
    assert torch.equal(early.opacity_logits, gaussians.opacity_logits)
    state = updated(gaussians, control, iteration=20)
    after = state.gaussians
    # 5% more would be 105
    assert after.count == 103
    assert float(after.opacities.min()) > control.options.dead_opacity - 1e-6
    # each that was transparent is where an opaque one is, and so are those that were added
    moved = torch.cat([after.means[:30], after.means[100:]])
    assert bool((moved[:, None] == gaussians.means[30:]).all(2).any(1).all())
    assert torch.equal(after.means[30:100], gaussians.means[30:])
    assert bool((state.moments.steps[:30] == 0).all())
    assert bool((state.moments.steps[100:] == 0).all())
    whole, copied = (render(scene, CAMERA).color[0] for scene in (gaussians, after))
    assert float((whole - copied).abs().mean()) < 0.01


def test_noise_moves_faint_gaussians_alone_along_their_own_axes() -> None:
    gaussians = some_gaussians(200)
    logits = torch.full((200,), 2.0)
    logits[:100] = math.log(0.002 / 0.998)
    flat = gaussians.log_scales.clone()
    flat[:, 2] = -9.0
    gaussians = replace(gaussians, opacity_logits=logits, log_scales=flat)
    control = McmcControl(budget=200, start=10, stop=1000, every=10)
    moved = updated(gaussians, control, iteration=5, rate=1e-4).gaussians.means - gaussians.means
    assert float(moved[100:].abs().max()) < 1e-6
    assert float(moved[:100].norm(dim=1).median()) > 1e-2
    along = (moved[:100, None] @ gaussians.rotations[:100])[:, 0]
    assert float(along[:, 2].abs().max()) < 1e-3 * float(along[:, 0].abs().max())
    again = updated(gaussians, control, iteration=5, rate=1e-4).gaussians.means - gaussians.means
    assert torch.equal(again, moved)
