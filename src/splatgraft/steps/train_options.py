"""What `train flux` and `train removal` are both asked: data, length, optimiser, machine. Does no work."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class DataOptions:
    """Which pairs, how they are mixed and how large they are."""

    pairs: tuple[Path, ...] = ()
    """Folders that `splatgraft synth pairs` rendered."""
    generated: tuple[Path, ...] = ()
    """Folders that `splatgraft synth generated` made."""
    orida: tuple[Path, ...] = ()
    """Folders that `splatgraft synth orida` made."""
    weights: tuple[float, ...] = ()
    """How often each folder is drawn from, in the order above; by their numbers of pairs where not given."""
    size: str = "704x496"
    """Pixels of a training picture, WIDTHxHEIGHT, multiples of 16."""
    held_out: float = 0.05
    """Share of the scenes that are kept for validation and never trained on."""


@dataclass(frozen=True)
class LoopOptions:
    """How long and how training runs."""

    steps: int = 50_000
    """Optimiser steps."""
    batch: int = 4
    """Pairs per optimiser step, over all processes together."""
    accumulate: int = 1
    """Passes that a process takes per optimiser step, to save memory."""
    rate: float = 3e-5
    """Learning rate of Adam."""
    warm_up: int = 0
    """Steps over which the rate rises from zero."""
    clip: float = 1.0
    """Largest norm of the gradient; 0 does not clip."""
    ema: float = 0.0
    """Decay of an averaged copy of the weights, which is then what is kept; 0 for none."""
    optimizer: Literal["adam", "adam8bit"] = "adam"
    """adam8bit needs bitsandbytes."""
    precision: Literal["no", "bf16", "fp16"] = "bf16"
    """Arithmetic of the network, weights of the optimiser are float32."""
    save_every: int = 1000
    """Steps between states from which a killed run goes on."""
    validate_every: int = 1000
    """Steps between validations."""
    validation_pairs: int = 8
    """Pairs per validation."""
    seed: int = 0
    """Order, noise and initial values follow from it."""
    tensorboard: bool = False
    """Also write for TensorBoard; needs the package tensorboard."""
