"""Memory that a training takes, per option, before it begins. Pure arithmetic; knows no network but its numbers."""

from dataclasses import dataclass, replace

_PER_BLOCK = 54
"""Bytes a token and channel that a block keeps; tests/harmonize/test_flux_memory.py measures them."""


@dataclass(frozen=True)
class TransformerSize:
    """Of a transformer and of what it is given."""

    parameters: int
    blocks: int
    width: int
    """Of a token."""
    tokens: int
    """Of one picture, text included."""
    adapted: int = 0
    """Sum of inputs and outputs of all adapted layers: parameters of an adaptation of rank 1."""


@dataclass(frozen=True)
class MemoryOptions:
    """Options that decide."""

    pairs: int
    """Per process and pass."""
    lora: int = 0
    adam8bit: bool = False
    ema: bool = False
    checkpointing: bool = True
    shards: int = 1
    """Processes that share weights, gradients and optimiser (FSDP, DeepSpeed stage 3)."""
    half: bool = True
    """Arithmetic in 16 bits."""


def training_bytes(size: TransformerSize, options: MemoryOptions) -> int:
    """Bytes on each device: weights, gradients, optimiser, average, activations.

    Learning weights are float32 (4), their gradients too (4), Adam's two moments (8, or 2 in 8 bits), an average (4),
    and a copy in 16 bits (2) that autocast keeps through a pass; what does not learn is bfloat16 (2). Measured on
    FLUX's blocks under autocast: a block keeps 54 bytes a token and channel for its backward pass, or 2 where it is
    computed again; twice that in 32 bits.
    """
    learning = options.lora * size.adapted if options.lora else size.parameters
    frozen = size.parameters if options.lora else 0
    each = 8 + (2 if options.adam8bit else 8) + (4 if options.ema else 0) + (2 if options.half else 0)
    activations = activation_bytes(size, options)
    return (learning * each + frozen * 2) // options.shards + activations + (1 << 30)


def activation_bytes(size: TransformerSize, options: MemoryOptions) -> int:
    """What of it the backward pass needs."""
    per_token = 2 * size.blocks + _PER_BLOCK if options.checkpointing else _PER_BLOCK * size.blocks
    return options.pairs * size.tokens * size.width * per_token * (1 if options.half else 2)


def memory_table(size: TransformerSize, options: MemoryOptions) -> list[str]:
    """A line for each way to train, the chosen one marked."""
    ways = {
        "all weights, adam": (0, False),
        "all weights, adam8bit": (0, True),
        f"lora of rank {options.lora or 64}": (options.lora or 64, options.adam8bit),
    }
    lines = []
    for name, (lora, small) in ways.items():
        way = replace(options, lora=lora, adam8bit=small)
        again = replace(way, checkpointing=not options.checkpointing)
        chosen = lora == options.lora and small == options.adam8bit
        words = ("with", "without") if options.checkpointing else ("without", "with")
        lines.append(
            f"{'* ' if chosen else '  '}{name}: {training_bytes(size, way) / 1e9:.0f} GB a device {words[0]} "
            f"checkpointing, {training_bytes(size, again) / 1e9:.0f} {words[1]}"
        )
    return lines
