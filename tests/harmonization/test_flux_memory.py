"""Memory: the best precision that fits is chosen."""

import pytest

from splatgraft.harmonization.flux.weights.placement import activation_bytes as tokens_bytes
from splatgraft.harmonization.flux.weights.placement import choose_placement, decoder_bytes

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
