"""fp8: products in 8 bits against a reference of numpy, and in a whole network."""

import numpy as np
import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, flux_folder, quiet, tiny_prompt, tiny_transformer

from splatgraft.harmonization.flux.network import velocity
from splatgraft.harmonization.flux.weights import loading
from splatgraft.harmonization.flux.weights.eight_bit import Float8Linear, multiplies_in_eight_bits, use_eight_bits
from splatgraft.harmonization.flux.weights.loading import FluxWeights, load_flux

pytestmark = list(quiet)
CPU = torch.device("cpu")
needs_products = pytest.mark.skipif(not multiplies_in_eight_bits(CPU), reason="no torch._scaled_mm on this CPU")


def in_eight_bits(values):
    """Round to float8_e4m3fn: 3 bits of mantissa, exponents down to -6, then even steps of 2^-9."""
    exponent = np.floor(np.log2(np.maximum(np.abs(values), 2.0**-6)))
    step = 2.0 ** (exponent - 3)
    return np.rint(values / step) * step


@needs_products
@pytest.mark.parametrize("bias", [True, False])
def test_a_layer_is_the_product_of_rounded_rows(bias):
    g = torch.Generator().manual_seed(0)
    layer = torch.nn.Linear(48, 32, bias=bias)
    with torch.no_grad():
        # rows of very different size: one scale for all would round the small ones away
        layer.weight.copy_(torch.randn(32, 48, generator=g) * torch.logspace(-4, 1, 32)[:, None])
    x = torch.randn(2, 5, 48, generator=g) * torch.logspace(-3, 2, 5)[:, None]
    made = Float8Linear(layer)(x).detach().numpy()
    rows, weight = x.reshape(-1, 48).double().numpy(), layer.weight.detach().double().numpy()
    sx, sw = (np.abs(m).max(1, keepdims=True) / 448 for m in (rows, weight))
    wanted = in_eight_bits(rows / sx) @ in_eight_bits(weight / sw).T * sx * sw.T
    wanted += layer.bias.detach().double().numpy() if bias else 0
    # float32 scales may move a value across the middle between two steps, of 1/16 of it, in one of 48 terms
    off = np.abs(made.reshape(-1, 32) - wanted)
    assert (off <= 0.01 * np.abs(wanted) + 0.01 * np.abs(wanted).max(0)).all()


@needs_products
def test_a_network_in_eight_bits_is_off_by_percents():
    network, prompt = tiny_transformer(CHANNELS * 12), tiny_prompt()
    g = torch.Generator().manual_seed(0)
    latents, level = torch.randn(1, CHANNELS * 3, 4, 6, generator=g), torch.tensor([0.5])
    with torch.no_grad():
        full = velocity(network, latents, level, prompt)
        count = use_eight_bits(network)
        rounded = velocity(network, latents, level, prompt)
    # attention and MLPs of one double and two single blocks, and their modulations, which are not baked here
    assert count == (8 + 4 + 2) + 2 * (3 + 2 + 1)
    assert 0 < float((rounded - full).abs().mean()) < 0.1 * float(full.abs().mean())
    assert all(type(m) is torch.nn.Linear for m in (network.x_embedder, network.context_embedder, network.proj_out))


def test_what_fp8_does_is_said(tmp_path, monkeypatch):
    folder, said = flux_folder(tmp_path / "image-mask", CHANNELS * 12), []
    if multiplies_in_eight_bits(CPU):
        network = load_flux(FluxWeights(str(folder), precision="fp8"), CPU, say=said.append)
        assert any("layers multiply in 8 bits, with a scale for each row" in line for line in said)
        assert any(isinstance(module, Float8Linear) for module in network.transformer.modules())
    monkeypatch.setattr(loading, "multiplies_in_eight_bits", lambda device: False)
    network = load_flux(FluxWeights(str(folder), precision="fp8"), CPU, say=said.append)
    assert "only stored in 8 bits and computed in torch.bfloat16: no torch._scaled_mm on cpu" in said[-1]
    assert not any(isinstance(module, Float8Linear) for module in network.transformer.modules())
