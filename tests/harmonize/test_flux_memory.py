"""Memory: what fits is chosen, what does not is said; predictions have the numbers of the real model."""

import pytest

from splatgraft.harmonize.flux.memory import activation_bytes, choose_placement, decoder_bytes
from splatgraft.train.prediction import Choice, Size, table, training_bytes

GB = 10**9
FLUX = {"parameters": 8_640_000_000, "others": 84_000_000}


def chosen(free, *, can_quantize=True, views=1):
    pixels = 704 * 496
    activations = activation_bytes(pixels=pixels, views=views, width=3072)
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


def test_training_flux_takes_the_paper_s_four_cards():
    width = 3072
    size = Size(parameters=11_890_000_000, blocks=57, width=width, tokens=1876, adapted=width * (36 * 19 + 20 * 38))
    one = training_bytes(size, Choice(pairs=1))
    # 12 billion weights, gradients and two moments in float32: 16 bytes each
    assert 190 * GB < one < 200 * GB
    assert training_bytes(size, Choice(pairs=1, shards=4)) < 80 * GB
    assert training_bytes(size, Choice(pairs=1, adam8bit=True)) < one - 60 * GB
    assert training_bytes(size, Choice(pairs=1, lora=64)) < 40 * GB
    assert training_bytes(size, Choice(pairs=1, ema=True)) > one
    assert training_bytes(size, Choice(pairs=4, checkpointing=False)) > training_bytes(size, Choice(pairs=4))
    lines = table(size, Choice(pairs=1, lora=16))
    assert [line.startswith("* ") for line in lines] == [False, False, True]
