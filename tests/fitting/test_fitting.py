"""The fit loop, its optimiser and its loss."""

from dataclasses import replace

import pytest
import torch

from splatgraft.core import cameras as camera_values
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import ssim
from splatgraft.fitting import FitOptions, FixedViews, LearningRates, adam, fit, l1_dssim
from splatgraft.fitting.view_colors import ViewColors
from splatgraft.rendering import render


def blobs(n: int, seed: int, degree: int = 1) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=0.5 * draw(n, 3),
        log_scales=-2.0 + 0.2 * draw(n, 3),
        quaternions=draw(n, 4),
        opacity_logits=draw(n),
        sh=0.5 * draw(n, (degree + 1) ** 2, 3),
    )


def ring(count: int, size: int = 32) -> camera_values.Cameras:
    angle = torch.arange(count) * (2 * torch.pi / count)
    eye = torch.stack([3 * angle.cos(), 3 * angle.sin(), torch.ones(count)], 1)
    poses = camera_values.look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return camera_values.pinhole(poses, 1.2 * size, width=size, height=size)


def pictures(scene: Gaussians, count: int = 6) -> FixedViews:
    cameras = ring(count)
    with torch.no_grad():
        return FixedViews(cameras, tuple(render(scene, cameras).color))


class Memo:
    """A checkpoint in memory that hands out copies."""

    def __init__(self) -> None:
        self.state = None

    def load(self):
        return self.state

    def save(self, state) -> None:
        def copy(value):
            if isinstance(value, dict):
                return {k: copy(v) for k, v in value.items()}
            return value.clone() if isinstance(value, torch.Tensor) else value

        self.state = copy(state)


class KilledError(Exception):
    pass


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


def test_colours_alone_are_recovered_and_all_else_stays():
    truth = blobs(60, 4)
    start = replace(truth, sh=torch.zeros_like(truth.sh))
    views = pictures(truth)
    options = FitOptions(iterations=120, rates=LearningRates(sh=0.05, sh_higher=0.05))
    fitted = fit(start, views, options=options)
    assert torch.equal(fitted.means, truth.means)
    assert torch.equal(fitted.opacity_logits, truth.opacity_logits)
    before, after = (
        torch.stack([(a - b).square().mean() for a, b in zip(pictures(g).images, views.images, strict=True)]).mean()
        for g in (start, fitted)
    )
    # linear in the colours, so nothing but the number of steps stands between the fit and zero error
    assert after < 0.02 * before


def test_every_field_that_has_a_rate_moves():
    truth = blobs(60, 5)
    rates = LearningRates(means=1e-3, log_scales=1e-3, quaternions=1e-3, opacity_logits=1e-3, sh=1e-3)
    fitted = fit(truth, pictures(blobs(60, 6)), options=FitOptions(iterations=6, rates=rates))
    for name in rates.active():
        assert not torch.equal(getattr(fitted, name), getattr(truth, name)), name
    assert torch.equal(fitted.sh[:, 1:], truth.sh[:, 1:])


def test_a_killed_fit_resumes_bit_for_bit(monkeypatch):
    monkeypatch.setattr("splatgraft.fitting.loop._CHECKPOINT_SECONDS", -1.0)
    views, start = pictures(blobs(60, 7)), blobs(60, 8)
    rates = LearningRates(means=1e-2, means_final=1e-4, log_scales=1e-2, quaternions=1e-2, opacity_logits=1e-2, sh=1e-2)
    options = FitOptions(iterations=40, rates=rates, seed=3)
    whole = fit(start, views, options=options)
    checkpoint = Memo()

    def die(done: int, total: int, message: str) -> None:
        if done == 20:
            raise KilledError

    with pytest.raises(KilledError):
        fit(start, views, options=options, progress=die, checkpoint=checkpoint)
    assert checkpoint.state is not None
    assert 0 < checkpoint.state["iteration"] < 40
    resumed = fit(start, views, options=options, checkpoint=checkpoint)
    for name in rates.active():
        assert torch.equal(getattr(whole, name), getattr(resumed, name)), name


def test_colours_that_differ_between_views_do_not_enter_the_scene():
    truth = blobs(60, seed=3, degree=0)
    views = pictures(truth)
    gains = (1.3, 0.7, 1.0, 1.2, 0.8, 1.0)
    tinted = FixedViews(views.cameras, tuple(g * image for g, image in zip(gains, views.images, strict=True)))
    grey = replace(truth, sh=torch.zeros_like(truth.sh))
    errors = []
    for rate in (0.0, 0.01):
        options = FitOptions(iterations=240, rates=LearningRates(sh=0.02), view_color_rate=rate)
        fitted = fit(grey, tinted, options=options)
        errors.append(float((fitted.sh - truth.sh).abs().median()))
    # the gains' mean is 1, so the scene's colours are those before the gains
    assert errors[1] < 0.7 * errors[0]


def test_the_mean_of_the_views_colours_stays_the_identity():
    colors = ViewColors.identity(5, torch.device("cpu"))
    generator = torch.Generator().manual_seed(0)
    for step in range(40):
        colors = colors.updated(step % 3, torch.randn(3, 4, generator=generator), 0.01)
    assert colors.maps.abs().max() > 0.01
    # float32 rounding of forty sums
    assert colors.maps.mean(0).abs().max() < 1e-6


def test_what_is_not_finite_is_an_error_that_says_so():
    views = pictures(blobs(20, 9))
    broken = FixedViews(views.cameras, tuple(image * float("nan") for image in views.images))
    with pytest.raises(ValueError, match="found a loss of nan at step 0"):
        fit(blobs(20, 9), broken, options=FitOptions(iterations=3, rates=LearningRates(sh=0.1)))


def test_no_views_is_an_error():
    views = pictures(blobs(5, 9))
    with pytest.raises(ValueError, match="at least one view"):
        fit(
            blobs(5, 9),
            FixedViews(views.cameras[:0], ()),
            options=FitOptions(iterations=3, rates=LearningRates(sh=0.1)),
        )


def test_rates_fall_as_3dgs_says():
    rates = LearningRates(means=1.6e-4, means_final=1.6e-6, sh=0.0025, sh_higher=0.0025 / 20)
    # exponential: the geometric mean half-way
    assert rates.means_at(0.5) == pytest.approx(1.6e-5)
    assert torch.allclose(rates.at("sh", 0.9, 12), torch.tensor([0.0025] * 3 + [0.0025 / 20] * 9))
    assert rates.active() == ("means", "sh")
