"""Padding, sampling, widening, baking, choice of the precision: exact against references, on tiny models."""

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, quiet, tiny_prompt, tiny_transformer

from splatgraft.harmonization.flux.baked_modulation import bake
from splatgraft.harmonization.flux.loading import choose_precision, working_bytes
from splatgraft.harmonization.flux.network import pad_by_reflection, velocity, widen_layer
from splatgraft.harmonization.flux.sampling import noisy, sample, schnell_levels

pytestmark = list(quiet)


def random(*size, seed=0):
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("h", "w"), [(32, 48), (31, 47), (17, 1), (5, 16), (1, 3)])
def test_padding_reaches_a_multiple_of_16_by_mirroring(h, w):
    image = random(1, 3, h, w)
    padded = pad_by_reflection(image)
    assert (padded is image) == (h % 16 == w % 16 == 0)
    assert padded.shape[2] % 16 == padded.shape[3] % 16 == 0
    assert torch.equal(padded[..., :h, :w], image)
    if h % 16 and h > 16:
        assert torch.equal(padded[..., h, :w], image[..., h - 2, :])
    if h > 8 and w > 8:
        reference = torch.nn.functional.pad(image, (0, -w % 16, 0, -h % 16), mode="reflect")
        assert torch.equal(padded, reference)


def test_the_true_velocity_leads_to_the_clean_latents_in_any_number_of_steps():
    clean, eps = random(2, 4, 4, 4), random(2, 4, 4, 4, seed=1)
    for steps in (1, 4, 7):
        # 7 additions of float32 values below 8: half an ulp of 4.8e-7 each
        assert torch.allclose(sample(lambda z, level: eps - clean, eps, schnell_levels(steps)), clean, atol=4e-6)
    assert torch.equal(noisy(clean, eps, torch.tensor([0.0, 1.0])), torch.stack([clean[0], eps[1]]))
    with pytest.raises(ValueError, match="--sampling-steps: expected at least 1, found 0"):
        schnell_levels(0)
    with pytest.raises(ValueError, match=r"strength: expected a noise level above 0 and at most 1, found 0\.0"):
        schnell_levels(4, start=0.0)


@pytest.mark.parametrize("init", ["repeat", "zero"])
@pytest.mark.parametrize("layer", [torch.nn.Linear(64, 8), torch.nn.Conv2d(4, 8, 3, padding=1)], ids=["linear", "conv"])
def test_a_widened_layer_holds_the_old_weights_bit_for_bit(layer, init):
    wide = widen_layer(layer, 3, init)
    old = layer.weight
    n = old.shape[1]
    assert wide.weight.shape[1] == 3 * n
    assert torch.equal(wide.weight[:, :n], old)
    assert torch.equal(wide.bias, layer.bias)
    for i in (1, 2):
        assert torch.equal(wide.weight[:, i * n : (i + 1) * n], old if init == "repeat" else torch.zeros_like(old))


def test_baked_gives_the_same():
    stock, baked = tiny_transformer(CHANNELS * 12), tiny_transformer(CHANNELS * 12)
    prompt, levels = tiny_prompt(), schnell_levels()[:-1]
    gone = bake(baked, prompt, levels)
    width = stock.inner_dim
    modulations = (2 * 6 + 2 * 3 + 2) * (width * width + width)  # one double block, two single, the last norm
    time_and_text = sum(p.numel() for p in stock.time_text_embed.parameters())
    assert gone == modulations + time_and_text
    latents = random(1, CHANNELS * 3, 4, 6)
    for level in levels:
        t = torch.tensor([level])
        with torch.no_grad():
            assert torch.equal(velocity(baked, latents, t, prompt), velocity(stock, latents, t, prompt))


def test_baked_in_bfloat16_and_in_batches_finds_its_rows():
    baked = tiny_transformer(CHANNELS * 12).to(torch.bfloat16)
    stock = tiny_transformer(CHANNELS * 12).to(torch.bfloat16)
    prompt = tiny_prompt().to(torch.device("cpu"), torch.bfloat16)
    bake(baked, prompt, schnell_levels()[:-1])
    latents = random(4, CHANNELS * 3, 4, 4).to(torch.bfloat16)
    t = torch.tensor([1.0, 0.75, 0.5, 0.25])
    with torch.no_grad():
        together = velocity(baked, latents, t, prompt)
        for i in range(4):
            alone = velocity(stock, latents[i : i + 1], t[i : i + 1], prompt)
            # batches round otherwise: a few steps of bfloat16 (2^-8) at values of about one
            assert torch.allclose(together[i], alone[0], atol=0.03)


GB = 10**9


def test_the_best_precision_that_fits_is_taken():
    working = working_bytes(pixels=704 * 496, width=3072)
    for free, precision in ((80, "bf16"), (24, "bf16"), (16, "fp8"), (8, "offload")):
        found, reason = choose_precision(parameters=8_640_000_000, working=working, free=free * GB)
        assert found == precision
        assert reason.endswith(f"of {free}.0 GB free")
    with pytest.raises(ValueError, match=r"GPU memory: expected \d.\d GB free even with blocks on the CPU, found 1.0"):
        choose_precision(parameters=8_640_000_000, working=working, free=GB)
