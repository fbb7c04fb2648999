"""Estimates the memory that a training will need on each device, from the network's size and the options."""

from dataclasses import dataclass, replace

_BYTES_PER_BLOCK = 54
"""Activations that a block keeps for its backward pass under autocast, bytes per token and channel; measured by
tests/harmonization/test_flux_memory.py."""
_BYTES_PER_CHECKPOINT = 2
"""The same for a block that is computed again in the backward pass."""
_RESERVED_BYTES = 1 << 30
"""For the CUDA context, kernels and fragmentation. An estimate."""


@dataclass(frozen=True)
class TransformerSize:
    """Size of a transformer and of its input."""

    parameters: int
    blocks: int
    width: int
    """Channels of a token."""
    tokens: int
    """Per image, text included."""
    adapted: int = 0
    """Sum of inputs and outputs of all adapted layers: the parameters of a low-rank adaptation of rank 1."""


@dataclass(frozen=True)
class MemoryOptions:
    """Training options that change the memory."""

    pairs: int
    """Per process and pass."""
    lora: int = 0
    """Rank; 0 trains all weights."""
    adam8bit: bool = False
    ema: bool = False
    checkpointing: bool = True
    shards: int = 1
    """Processes that share weights, gradients and optimiser (`--parallel shards`)."""
    half: bool = True
    """Arithmetic in 16 bits."""


def training_bytes(size: TransformerSize, options: MemoryOptions) -> int:
    """Estimate the bytes on each device: weights, gradients, optimiser, moving average, activations.

    A trainable parameter takes 4 bytes (float32), its gradient 4, Adam's two moments 8 (or 2 in 8 bits), the moving
    average 4, and the 16-bit copy that autocast keeps through a pass 2; a frozen parameter takes 2 (bfloat16).
    Activations in 32 bits take twice those in 16 bits.
    """
    trained = options.lora * size.adapted if options.lora else size.parameters
    frozen = size.parameters if options.lora else 0
    each = 8 + (2 if options.adam8bit else 8) + (4 if options.ema else 0) + (2 if options.half else 0)
    activations = activation_bytes(size, options)
    return (trained * each + frozen * 2) // options.shards + activations + _RESERVED_BYTES


def activation_bytes(size: TransformerSize, options: MemoryOptions) -> int:
    """Estimate the bytes of the activations kept for the backward pass."""
    kept_blocks = _BYTES_PER_BLOCK * size.blocks
    per_token = _BYTES_PER_CHECKPOINT * size.blocks + _BYTES_PER_BLOCK if options.checkpointing else kept_blocks
    return options.pairs * size.tokens * size.width * per_token * (1 if options.half else 2)


def memory_table(size: TransformerSize, options: MemoryOptions) -> list[str]:
    """Format one line per combination of weights and optimiser; the chosen one is marked by an asterisk."""
    combinations = {
        "all weights, adam": (0, False),
        "all weights, adam8bit": (0, True),
        f"lora of rank {options.lora or 64}": (options.lora or 64, options.adam8bit),
    }
    lines = []
    for name, (lora, small) in combinations.items():
        variant = replace(options, lora=lora, adam8bit=small)
        chosen_bytes = training_bytes(size, variant)
        other_bytes = training_bytes(size, replace(variant, checkpointing=not options.checkpointing))
        chosen = lora == options.lora and small == options.adam8bit
        words = ("with", "without") if options.checkpointing else ("without", "with")
        lines.append(
            f"{'* ' if chosen else '  '}{name}: {chosen_bytes / 1e9:.0f} GB a device {words[0]} checkpointing, "
            f"{other_bytes / 1e9:.0f} {words[1]}"
        )
    return lines
