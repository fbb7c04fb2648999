"""The sparse Adam against torch's, and the fused L1 and D-SSIM loss against its definition."""

import pytest
import torch

from splatgraft.core.image_metrics import ssim
from splatgraft.fitting import adam, l1_dssim


def test_the_fused_loss_is_the_textbook_one():
    generator = torch.Generator().manual_seed(0)
    image, reference = torch.rand(2, 37, 29, 3, generator=generator)
    for weight in (0.2, 1.0):
        fused, plain = image.clone().requires_grad_(), image.double().requires_grad_()
        loss = l1_dssim(fused, reference, dssim_weight=weight)
        want = (1 - weight) * (plain - reference).abs().mean() + weight * (1 - ssim(plain, reference.double()))
        loss.backward()
        want.backward()
        # float32 sums of 121 products of values up to 1: about 1e-5 relative after the division by small variances
        assert abs(float(loss.detach() - want.detach())) < 1e-5
        assert (fused.grad - plain.grad).abs().max() < 1e-4 * plain.grad.abs().max()


def test_the_loss_names_the_size_of_an_image_too_small_for_it():
    with pytest.raises(ValueError, match="found 8x20"):
        l1_dssim(torch.zeros(20, 8, 3), torch.zeros(20, 8, 3))


def test_adam_with_all_rows_visible_is_torchs_adam():
    generator = torch.Generator().manual_seed(1)
    start = torch.randn(50, 4, generator=generator)
    value, judge = {"x": start.clone()}, torch.nn.Parameter(start.clone())
    optimiser = torch.optim.Adam([judge], lr=0.01, eps=adam.EPSILON)
    moments = adam.no_moments(value, 50)
    for _ in range(20):
        gradient = torch.randn(50, 4, generator=generator)
        judge.grad = gradient.clone()
        optimiser.step()
        seen = torch.ones(50, dtype=torch.bool)
        rates = {"x": torch.full((4,), 0.01)}
        assert adam.step(value, {"x": gradient}, moments=moments, rates=rates, visible=seen)
    # 20 steps of at most 0.01 each, every one exact to a few float32 roundings (1e-7 relative)
    assert (value["x"] - judge.detach()).abs().max() < 2e-6


def test_both_forms_of_adam_agree_and_leave_unseen_rows_alone():
    generator = torch.Generator().manual_seed(2)
    start = torch.randn(40, 3, generator=generator)
    results = []
    for update in (adam._step_numba, adam._step_torch):
        value, first, second = start.clone(), torch.zeros(40, 3), torch.zeros(40, 3)
        steps, generator = torch.zeros(40, dtype=torch.int32), torch.Generator().manual_seed(3)
        for _ in range(10):
            seen = torch.rand(40, generator=generator) < 0.5
            seen[0] = False
            steps[seen] += 1
            gradient = torch.randn(40, 3, generator=generator)
            assert update(((value,), (gradient,), (first,), (second,)), steps, (torch.tensor([0.1, 0.2, 0.0]),), seen)
        results.append(value)
    assert torch.equal(results[0][0], start[0])
    assert torch.equal(results[0][:, 2], start[:, 2])
    # ten steps of at most 0.2, each exact to a few float32 roundings
    assert (results[0] - results[1]).abs().max() < 1e-5


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_moves_nothing(bad):
    for update in (adam._step_numba, adam._step_torch):
        value, gradient = torch.ones(3, 2), torch.ones(3, 2)
        gradient[1, 0] = bad
        seen = torch.ones(3, dtype=torch.bool)
        rows = ((value,), (gradient,), (torch.zeros(3, 2),), (torch.zeros(3, 2),))
        assert not update(rows, torch.ones(3, dtype=torch.int32), (torch.full((2,), 0.1),), seen)
        assert torch.equal(value[1], torch.ones(2))
