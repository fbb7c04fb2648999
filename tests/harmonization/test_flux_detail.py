"""Post-processing of FLUX: the composite's detail is restored, and changes of material are limited."""

import pytest
import torch

from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import linear_from_srgb, list_images, read_rgb, resize, srgb_from_linear
from splatgraft.harmonization.flux.detail import guided_filter, limit_material_change, restore_detail


def photograph(side=128):
    from pathlib import Path

    folder = Path(__file__).parents[2] / "src" / "splatgraft" / "demo_captures" / "bananas" / "images"
    return resize(read_rgb(list_images(folder)[0]), side, side).clamp(0.02, 1)


def relit(image, gain):
    return srgb_from_linear(linear_from_srgb(image) * gain).clamp(0, 1)


def blurred(image, radius=2):
    planes = image.permute(2, 0, 1)[None]
    size = 2 * radius + 1
    return torch.nn.functional.avg_pool2d(planes, size, 1, radius, count_include_pad=False)[0].permute(1, 2, 0)


def shading(side=128):
    """A smooth change of light with a tint: darker and redder to the right."""
    ramp = torch.linspace(1, 0.4, side).expand(side, side)[..., None]
    return ramp * torch.tensor([1.0, 0.9, 0.8])


def test_what_an_autoencoder_blurs_comes_back_and_the_light_stays():
    composite = photograph()
    truth = relit(composite, shading())
    seen = blurred(truth)  # stands for what the autoencoder makes of the right answer
    cured = restore_detail(seen, composite, amount=1.0)
    assert psnr(cured, truth) > psnr(seen, truth) + 10
    half = restore_detail(seen, composite, amount=0.5)
    assert psnr(seen, truth) < psnr(half, truth) < psnr(cured, truth)


def test_a_cast_shadow_s_edge_survives_about():
    composite = photograph()
    shadow = torch.ones(128, 128, 1)
    shadow[:, 64:] = 0.4
    truth = relit(composite, shadow.expand(-1, -1, 3))
    cured = restore_detail(truth, composite, amount=1.0)
    far = torch.ones(128, 128, dtype=torch.bool)
    far[:, 64 - 20 : 64 + 20] = False  # two windows of 8 px either way
    assert psnr(cured, truth, far) > 35


def test_off_is_off_and_a_model_that_changes_nothing_changes_nothing():
    composite = photograph(64)
    model = relit(composite, shading(64))
    mask = torch.ones(64, 64)
    assert restore_detail(model, composite, amount=0.0) is model
    assert limit_material_change(model, composite, mask, strength=1.0) is model
    # ratios of exactly one, through two transfer functions in float32
    assert torch.allclose(restore_detail(composite, composite, amount=1.0), composite, atol=1e-5)
    assert torch.allclose(limit_material_change(composite, composite, mask, strength=0.0), composite, atol=1e-5)


def test_a_changed_material_is_held_and_a_changed_light_is_not():
    composite = photograph()
    mask = torch.zeros(128, 128)
    mask[32:96, 32:96] = 1
    lit = relit(composite, shading())
    stripes = (torch.arange(128) % 6 < 3).float()[None, :, None]
    changed = torch.lerp(lit, stripes.expand(128, 128, 3) * torch.tensor([0.2, 0.9, 0.4]), 0.4)
    model = torch.where(mask[..., None] > 0, changed, lit)
    errors = [
        float(((limit_material_change(model, composite, mask, strength=s) - lit) ** 2).mean()) for s in (1.0, 0.5, 0.0)
    ]
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < errors[0] / 3
    assert torch.equal(limit_material_change(model, composite, mask, strength=0.0)[mask == 0], model[mask == 0])


def test_the_filter_keeps_edges_of_its_guide_and_means_of_its_signal():
    guide = torch.zeros(40, 40)
    guide[:, 20:] = 1
    signal = guide[..., None] + 0.1 * torch.randn(40, 40, 1, generator=torch.Generator().manual_seed(0))
    smooth = guided_filter(signal, guide, 4)
    # the slope is 1 / (1 + edge / variance) = 0.93 where the window sees both sides alike (variance 0.25), averaged
    # over windows that see less of one
    assert (smooth[:, 20] - smooth[:, 19]).mean() > 0.85
    # 81 values of deviation 0.1, averaged twice: 0.011 each at most
    assert smooth[:, :10].std() < 0.03


@pytest.mark.parametrize("size", [(5, 7), (1, 40)])
def test_pictures_smaller_than_the_window_work(size):
    image = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0))
    assert bool(restore_detail(image, image * 0.5 + 0.1, amount=1.0).isfinite().all())
