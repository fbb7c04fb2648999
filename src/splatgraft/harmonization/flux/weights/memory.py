"""What fits into the memory that is free: which precision, what is left on the CPU. Pure arithmetic, tested as such."""

from dataclasses import dataclass
from typing import Literal, get_args

Precision = Literal["bf16", "fp8", "nf4", "offload", "float32"]
"""bf16 whole; weights kept in 8 bits (fp8 layerwise casting) or 4 (NF4); groups of blocks fetched from the CPU."""
PRECISIONS: tuple[str, ...] = get_args(Precision)
_BYTES = {"bf16": 2.0, "fp8": 1.0, "nf4": 0.56, "offload": 0.1, "float32": 4.0}
"""Per parameter on the device; nf4 with its scales and what stays in bf16, offload with the two groups in use."""
_SPARE = 1 << 30
"""For the context, kernels and fragments."""


@dataclass(frozen=True)
class Placement:
    """How the transformer lies in memory."""

    precision: Precision
    """Of its weights."""
    tiled: bool
    """Whether the autoencoder works tile by tile."""
    sentence: str
    """The choice and its reason, for the person who waits."""


def activation_bytes(*, pixels: int, views: int, width: int) -> int:
    """Largest activations of one pass of the transformer: some 40 bf16 copies of its tokens (the MLP's four included).

    `pixels` of one view, `width` of the tokens; text adds 512 tokens.
    """
    return views * (pixels // 256 + 512) * width * 2 * 40


def decoder_bytes(*, pixels: int, views: int) -> int:
    """Largest activations of the autoencoder's decoder: 256 channels at full size, three copies of two bytes."""
    return views * pixels * 256 * 2 * 3


def choose_placement(
    *, parameters: int, others: int, activations: int, decoder: int, free: int, can_quantize: bool
) -> Placement:
    """The best precision that fits `free` bytes; `others`: parameters of the autoencoder, kept in bf16.

    `can_quantize`: whether bitsandbytes is there.

    Raises: ValueError where not even offloading fits.
    """
    fixed = others * 2 + _SPARE
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
        "fp8": "fp8 weights cast layer by layer, since bf16 does not fit",
        "nf4": "4-bit weights (NF4), since fp8 does not fit",
        "offload": "blocks fetched from the CPU, slow, since no precision fits",
    }
    tiles = ", autoencoder in tiles" if tiled else ""
    return f"flux: {names[precision]}{tiles}; needs {need / 1e9:.1f} of {free / 1e9:.1f} GB free"
