"""What a harmoniser's maker may be told; each takes of it what it needs. Knows no harmoniser."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch


def _nobody(sentence: str) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class HarmonizerOptions:
    """Weights, machine and taste."""

    weights: str | None = None
    """Folder, file or hub id of the weights."""
    base: str | None = None
    """Folder or hub id of what the weights were trained from, for parts that they lack."""
    lora: Path | None = None
    """A low-rank adaptation to merge into the weights."""
    variant: str = "auto"
    """What the network is given beside the composite, where its folder does not say."""
    checkout: Path | None = None
    """Folder of another project's code, where the method runs in that."""
    seed: int = 0
    """Of whatever is drawn at random."""
    sampling_steps: int = 4
    """Of a diffusion model."""
    strength: float = 1.0
    """How far the object's material may change, in [0, 1]."""
    detail: float = 0.0
    """How much of the result is the composite's own pixels under the model's light, in [0, 1]."""
    device: torch.device = torch.device("cpu")  # noqa: RUF009
    """Where the network runs."""
    precision: str = "auto"
    """Of its weights."""
    batch: int = 1
    """Views at once."""
    compiled: bool = False
    """Compile the network first."""
    views: int = 1
    """How many will be asked for."""
    pixels: int = 704 * 496
    """Of each."""
    max_cost: float = 0.0
    """US dollars that may be spent at most."""
    key: str | None = None
    """Of a service that asks for one."""
    say: Callable[[str], None] = _nobody
    """For sentences to the person who waits."""
