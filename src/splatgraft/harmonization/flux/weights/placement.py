"""Chooses the transformer's precision and placement from the free GPU memory."""

from dataclasses import dataclass
from typing import Literal, get_args

Precision = Literal["bf16", "fp8", "nf4", "offload", "float32"]
"""Weights in bfloat16, in 8 bits (fp8, multiplied so where the device can) or 4 bits (NF4), or on the CPU by block."""
PRECISIONS: tuple[str, ...] = get_args(Precision)
_BYTES = {"bf16": 2.0, "fp8": 1.0, "nf4": 0.56, "offload": 0.1, "float32": 4.0}
"""Per parameter on the device; nf4 includes its scales and the bf16 layers, offload the two groups in use."""
_RESERVED_BYTES = 1 << 30
"""For the CUDA context, kernels and fragmentation. An estimate."""


@dataclass(frozen=True)
class Placement:
    """Precision and placement of the network."""

    precision: Precision
    """Of the transformer's weights."""
    tiled: bool
    """Whether the autoencoder processes images in tiles."""
    sentence: str
    """The choice and its reason, to be shown to the user."""


def activation_bytes(*, pixels: int, views: int, width: int) -> int:
    """Estimate the largest activations of one pass of the transformer: about 40 bf16 copies of its tokens.

    Args:
        pixels: of one view; a token covers 256 of them, and text adds 512 tokens.
        views: per pass.
        width: channels of a token.
    """
    return views * (pixels // 256 + 512) * width * 2 * 40


def decoder_bytes(*, pixels: int, views: int) -> int:
    """Estimate the largest activations of the decoder: three 2-byte copies of 256 channels at full size."""
    return views * pixels * 256 * 2 * 3


def choose_placement(
    *, parameters: int, others: int, activations: int, decoder: int, free: int, can_quantize: bool
) -> Placement:
    """Choose the best precision that fits.

    Args:
        parameters: of the transformer.
        others: parameters of the autoencoder, kept in bf16.
        activations: bytes, see `activation_bytes`.
        decoder: bytes, see `decoder_bytes`; a sixteenth of them where images are decoded in tiles.
        free: bytes.
        can_quantize: whether bitsandbytes is installed.

    Raises:
        ValueError: not even offloading fits.
    """
    fixed = others * 2 + _RESERVED_BYTES
    for precision in ("bf16", "fp8", "nf4", "offload"):
        for tiled in (False, True):
            working = max(activations, decoder // 16 if tiled else decoder)
            need = round(parameters * _BYTES[precision]) + fixed + working
            if need <= free and (precision != "nf4" or can_quantize):
                return Placement(precision, tiled, _sentence(precision, tiled, need, free))
    need = round(parameters * _BYTES["offload"]) + fixed + max(activations, decoder // 16)
    raise ValueError(
        f"GPU memory: expected {need / 1e9:.1f} GB free even with offloading, found {free / 1e9:.1f} GB; "
        "close other programs, use smaller views or --batch 1"
    )


def _sentence(precision: str, tiled: bool, need: int, free: int) -> str:
    names = {
        "bf16": "bf16",
        "fp8": "fp8 weights, since bf16 does not fit",
        "nf4": "4-bit weights (NF4), since fp8 does not fit",
        "offload": "blocks fetched from the CPU (slow), since no precision fits",
    }
    tiles = ", autoencoder in tiles" if tiled else ""
    return f"flux: {names[precision]}{tiles}; needs {need / 1e9:.1f} of {free / 1e9:.1f} GB free"
