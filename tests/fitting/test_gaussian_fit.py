"""The loop that fits Gaussians to images: fields, rates, the views' colours."""

from dataclasses import replace

import pytest
import shapes
import torch

from splatgraft.core import cameras as camera_values
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting.gaussian_fit import FitOptions, LearningRates, View, ViewColors, fit
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


def ring(count: int) -> camera_values.Cameras:
    return shapes.ring(count, height=1.0, radius=3.0, focal=38.4, size=(32, 32))


class Photographs(list[View]):
    """Views that every step sees at full size."""

    def at(self, index: int, *, visit: int, done: float) -> View:
        return self[index]


def as_views(cameras: camera_values.Cameras, images: list[torch.Tensor]) -> Photographs:
    pictures = [(255 * image.clamp(0, 1)).round().to(torch.uint8) for image in images]
    return Photographs(View(camera, image) for camera, image in zip(cameras, pictures, strict=True))


def views_of(scene: Gaussians, gains: tuple[float, ...] = (1.0,) * 6) -> Photographs:
    cameras = ring(len(gains))
    with torch.no_grad():
        return as_views(cameras, [g * image for g, image in zip(gains, render(scene, cameras).color, strict=True)])


def test_colours_alone_are_recovered_and_all_else_stays():
    truth = blobs(60, 4)
    start = replace(truth, sh=torch.zeros_like(truth.sh))
    rates = LearningRates(sh=0.05, sh_higher=0.05)
    fitted = fit(start, views_of(truth), FitOptions(120, rates))
    assert torch.equal(fitted.means, truth.means)
    assert torch.equal(fitted.opacity_logits, truth.opacity_logits)
    before, after = (
        (render(g, ring(6)).color.clamp(0, 1) - render(truth, ring(6)).color.clamp(0, 1)).square().mean()
        for g in (start, fitted)
    )
    # linear in the colours, so only the number of steps separates the fit from zero error
    assert after < 0.02 * before


def test_every_field_that_has_a_rate_moves():
    truth = blobs(60, 5)
    rates = LearningRates(means=1e-3, log_scales=1e-3, quaternions=1e-3, opacity_logits=1e-3, sh=1e-3)
    fitted = fit(truth, views_of(blobs(60, 6)), FitOptions(6, rates))
    for name in rates.active():
        assert not torch.equal(getattr(fitted, name), getattr(truth, name)), name
    assert torch.equal(fitted.sh[:, 1:], truth.sh[:, 1:])


def test_colours_that_differ_between_views_do_not_enter_the_scene():
    truth = blobs(60, seed=3, degree=0)
    tinted = views_of(truth, gains=(1.3, 0.7, 1.0, 1.2, 0.8, 1.0))
    grey = replace(truth, sh=torch.zeros_like(truth.sh))
    errors = []
    for rate in (0.0, 0.01):
        rates = LearningRates(sh=0.02, view_colors=rate)
        fitted = fit(grey, tinted, FitOptions(240, rates))
        errors.append(float((fitted.sh - truth.sh).abs().median()))
    # the gains' mean is 1, so the scene's colours are those before the gains
    assert errors[1] < 0.7 * errors[0]


def test_views_that_are_brighter_from_one_side_do_not_make_the_scene_brighter_from_there():
    truth = blobs(60, seed=3)
    truth = replace(truth, sh=torch.cat([truth.sh[:, :1], torch.zeros(60, 3, 3)], 1))
    gains = (1.3, 1.3, 1.3, 0.7, 0.7, 0.7)
    views, grey = views_of(truth, gains), replace(truth, sh=torch.zeros_like(truth.sh))
    # measure of the dependence of colour on direction
    bands = []
    for known in (None, gains):
        rates = LearningRates(sh=0.02, sh_higher=0.02, view_colors=0.003)
        bands.append(float(fit(grey, views, FitOptions(180, rates, view_gains=known)).sh[:, 1:].abs().mean()))
    assert bands[1] < 0.7 * bands[0]


def test_a_random_background_leaves_no_holes_before_what_is_dark():
    dark, cameras = replace(blobs(60, 4), sh=torch.full((60, 4, 3), -0.5)), ring(6)
    views = as_views(cameras, [torch.zeros(32, 32, 3)] * 6)
    alphas = []
    for random in (False, True):
        background = None if random else (0.0, 0.0, 0.0)
        fitted = fit(dark, views, FitOptions(60, LearningRates(opacity_logits=0.05), background))
        alphas.append(float(render(fitted, cameras).alpha.mean()))
    # light of a random background, half bright in the mean, that comes through is an equal error
    assert alphas[1] > 1.1 * alphas[0]


def test_what_a_mask_leaves_out_shows_the_background_and_what_is_hidden_counts_for_nothing():
    truth, cameras = blobs(60, 4), ring(6)
    drawn = render(truth, cameras)
    whole = as_views(cameras, list(drawn.color))
    masks = [(255 * alpha[..., None]).round().to(torch.uint8) for alpha in drawn.alpha]
    left = torch.arange(32)[None, :, None].expand(32, 32, 1) < 16

    def error(views: Photographs) -> tuple[float, float]:
        """Return mean opacity after a fit from a thinner scene, in the left and in the right half."""
        thin = replace(truth, opacity_logits=truth.opacity_logits - 2)
        fitted = fit(thin, views, FitOptions(90, LearningRates(opacity_logits=0.1), background=None))
        missed = (render(fitted, cameras).alpha - drawn.alpha)[..., None].abs()
        return float(missed[:, left].mean()), float(missed[:, ~left].mean())

    # without masks, the fit takes the black around the object for its surface
    seen = [replace(view, mask=mask, image=_over_nothing(view, mask)) for view, mask in zip(whole, masks, strict=True)]
    assert sum(error(Photographs(seen))) < 0.5 * sum(error(whole))
    # an occluder hides the right half, so it is not in the masks
    hidden = [replace(view, mask=view.mask * left) for view in seen]
    ignored = Photographs(replace(view, is_compared=left) for view in hidden)
    assert error(ignored)[1] < 0.5 * error(Photographs(hidden))[1]


def _over_nothing(view: View, mask: torch.Tensor) -> torch.Tensor:
    """Return the colours of a picture over black, undoing the multiplication by its mask."""
    return (view.image.float() / mask.float().clamp_min(1) * 255).clamp(0, 255).round().to(torch.uint8)


def test_the_mean_of_the_views_colours_stays_the_identity():
    colors = ViewColors.start(torch.ones(5))
    generator = torch.Generator().manual_seed(0)
    for step in range(40):
        colors = colors.updated(step % 3, torch.randn(3, 4, generator=generator), 0.01)
    assert colors.maps.abs().max() > 0.01
    # float32 rounding of forty sums
    assert colors.maps.mean(0).abs().max() < 1e-6


def test_what_is_not_finite_is_an_error_that_says_so():
    broken = replace(blobs(20, 9), sh=torch.full((20, 4, 3), float("nan")))
    with pytest.raises(ValueError, match="found a loss of nan at step 0"):
        fit(broken, views_of(blobs(20, 9)), FitOptions(3, LearningRates(sh=0.1)))


def test_rates_fall_as_3dgs_says():
    rates = LearningRates(means=1.6e-4, means_final=1.6e-6, sh=0.0025, sh_higher=0.0025 / 20)
    # exponential: the geometric mean half-way
    assert torch.allclose(rates.at("means", 0.5, 3), torch.full((3,), 1.6e-5))
    assert torch.allclose(rates.at("sh", 0.9, 12), torch.tensor([0.0025] * 3 + [0.0025 / 20] * 9))
    assert rates.active() == ("means", "sh")
