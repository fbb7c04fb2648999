"""Memory: the best precision that fits is chosen, and estimates agree with measured activations."""

import pytest
import torch

from splatgraft.harmonization.flux.empty_prompt import PromptEmbedding
from splatgraft.harmonization.flux.network import velocity
from splatgraft.harmonization.flux.weights.placement import activation_bytes as tokens_bytes
from splatgraft.harmonization.flux.weights.placement import choose_placement, decoder_bytes
from splatgraft_paper.training.memory_estimate import (
    MemoryOptions,
    TransformerSize,
    activation_bytes,
    memory_table,
    training_bytes,
)

GB = 10**9
FLUX = {"parameters": 8_640_000_000, "others": 84_000_000}


def chosen(free, *, can_quantize=True, views=1):
    pixels = 704 * 496
    activations = tokens_bytes(pixels=pixels, views=views, width=3072)
    decoder = decoder_bytes(pixels=pixels, views=views)
    return choose_placement(**FLUX, activations=activations, decoder=decoder, free=free, can_quantize=can_quantize)


@pytest.mark.parametrize(
    ("free", "precision"),
    [(80 * GB, "bf16"), (24 * GB, "bf16"), (16 * GB, "fp8"), (8 * GB, "nf4"), (4 * GB, "offload")],
)
def test_the_best_precision_that_fits_is_taken_and_said(free, precision):
    found = chosen(free)
    assert found.precision == precision
    assert f"of {free / GB:.1f} GB free" in found.sentence


def test_without_bitsandbytes_blocks_are_fetched_instead():
    assert chosen(8 * GB, can_quantize=False).precision == "offload"


def test_many_views_need_tiles_before_anything_is_quantised_away():
    # 128 views: 69 GB for the decoder at once, a sixteenth of it in tiles; the 59 GB of tokens stay
    assert not chosen(141 * GB, views=128).tiled
    found = chosen(80 * GB, views=128)
    assert found.tiled
    assert found.precision == "bf16"


def test_what_cannot_fit_is_one_line_with_both_numbers():
    with pytest.raises(ValueError, match=r"GPU memory: expected 2.\d GB free even with offloading, found 1.0 GB"):
        chosen(1 * GB)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("checkpointing", [False, True])
def test_the_activations_predicted_are_those_that_are_kept(checkpointing):
    diffusers = pytest.importorskip("diffusers")
    width, blocks, kept = 256, 6, []
    network = diffusers.FluxTransformer2DModel(
        in_channels=48, out_channels=16, num_layers=2, num_single_layers=4, attention_head_dim=64,
        num_attention_heads=4, joint_attention_dim=32, pooled_projection_dim=16, axes_dims_rope=(8, 28, 28),
    )  # fmt: skip
    if checkpointing:
        network.enable_gradient_checkpointing()
    prompt = PromptEmbedding(torch.randn(16, 32), torch.randn(16))
    weights = {p.untyped_storage().data_ptr() for p in network.parameters()}
    sides = (16, 32)
    for side in sides:
        found = {}

        def note(tensor, found=found):
            if tensor.untyped_storage().data_ptr() not in weights:
                found[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        with (
            torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor),
            torch.autocast("cpu", torch.bfloat16),
        ):
            velocity(network, torch.randn(1, 12, side, side), torch.tensor([0.5]), prompt)
        kept.append(sum(found.values()))
    # two sizes, so that copies of weights, which do not grow, fall out
    tokens = (sides[1] ** 2 - sides[0] ** 2) // 4
    size = TransformerSize(parameters=0, blocks=blocks, width=width, tokens=tokens)
    predicted = activation_bytes(size, MemoryOptions(1, checkpointing=checkpointing))
    # a block that is computed again is not among what is kept through the forward pass
    predicted -= 54 * tokens * width if checkpointing else 0
    # ends of the network and odds of a block: some 7 bytes a token and channel with 6 blocks
    assert 0.95 * predicted < kept[1] - kept[0] < predicted + 12 * tokens * width


def test_training_flux_takes_the_paper_s_four_cards():
    width = 3072
    size = TransformerSize(
        parameters=11_890_000_000, blocks=57, width=width, tokens=1876, adapted=width * (36 * 19 + 20 * 38)
    )
    one = training_bytes(size, MemoryOptions(pairs=1))
    # 12 billion weights, gradients and two moments in float32 and a copy in 16 bits: 18 bytes each
    assert 214 * GB < one < 218 * GB
    assert training_bytes(size, MemoryOptions(pairs=1, shards=4)) < 80 * GB
    assert training_bytes(size, MemoryOptions(pairs=1, adam8bit=True)) < one - 60 * GB
    assert training_bytes(size, MemoryOptions(pairs=1, lora=64)) < 40 * GB
    assert training_bytes(size, MemoryOptions(pairs=1, ema=True)) > one
    assert training_bytes(size, MemoryOptions(pairs=4, checkpointing=False)) > training_bytes(
        size, MemoryOptions(pairs=4)
    )
    lines = memory_table(size, MemoryOptions(pairs=1, lora=16))
    assert [line.startswith("* ") for line in lines] == [False, False, True]
