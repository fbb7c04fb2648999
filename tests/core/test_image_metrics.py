"""PSNR and SSIM against scikit-image, whole and inside regions."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from splatgraft.core.image_metrics import fit_color, psnr, ssim, ssim_map


def noisy_pair(seed=0, height=37, width=53):
    g = torch.Generator().manual_seed(seed)
    rows, columns = torch.arange(height)[:, None, None] / height, torch.arange(width)[None, :, None] / width
    reference = (0.5 + 0.4 * torch.sin(9 * rows + torch.tensor([3.0, 5, 7]) * columns)).float()
    return (reference + 0.08 * torch.randn(height, width, 3, generator=g)).clamp(0, 1), reference


def test_psnr_agrees_with_scikit_image():
    image, reference = noisy_pair()
    expected = peak_signal_noise_ratio(reference.double().numpy(), image.double().numpy(), data_range=1)
    assert float(psnr(image, reference)) == pytest.approx(expected, abs=1e-4)  # float32 mean of 6k squares


def test_ssim_agrees_with_scikit_image():
    image, reference = noisy_pair()
    expected, full = structural_similarity(
        reference.double().numpy(),
        image.double().numpy(),
        data_range=1,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    # variances of order 1e-2 come from differences of float32 moments of order 1: errors of 1e-7 / 1e-2, some windows
    assert float(ssim(image, reference)) == pytest.approx(expected, abs=1e-4)
    assert np.abs(ssim_map(image, reference).numpy() - full[5:-5, 5:-5]).max() < 2e-3


def test_region_metrics_see_only_the_region():
    image, reference = noisy_pair()
    region = torch.zeros(37, 53, dtype=torch.bool)
    region[12:20, 20:40] = True
    elsewhere = image.clone()
    elsewhere[0] = 1 - elsewhere[0]
    assert torch.equal(psnr(image, reference, region), psnr(elsewhere, reference, region))
    # row 0 lies outside every window centred in rows 12-19
    assert torch.equal(ssim(image, reference, region), ssim(elsewhere, reference, region))
    assert math.isnan(float(psnr(image, reference, torch.zeros_like(region))))


def test_small_images_are_refused():
    with pytest.raises(ValueError, match="at least 11x11 pixels, found 20x10"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))


def test_a_fit_of_colours_leaves_no_trace_of_exposure_and_white_balance():
    image = torch.rand(40, 50, 3)
    reference = 0.1 + image @ torch.tensor([[0.7, 0.05, 0.0], [0.0, 0.6, 0.05], [0.02, 0.0, 0.8]]).T
    # the ridge of 1e-6 against variances of 1/12 leaves about 1e-5 of the change
    assert torch.allclose(fit_color(image, reference), reference, atol=1e-4)
    flat = torch.full((12, 12, 3), 0.5)
    assert torch.isfinite(fit_color(flat, flat)).all()
