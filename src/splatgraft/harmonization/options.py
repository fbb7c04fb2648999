"""Options of the harmonisers, one class per method, and the context in which a harmoniser is made."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch


@dataclass(frozen=True)
class NoneOptions:
    """Keep the light transfer's result: no image model."""

    name: ClassVar[str] = "none"


@dataclass(frozen=True)
class CompactOptions:
    """Correct the light transfer with the shipped network of 2.4 M parameters; runs on any CPU."""

    name: ClassVar[str] = "compact"

    weights: str | None = None
    """A compact.safetensors, or the folder of a training; the shipped weights where not given."""
    strength: float = 1.0
    """How much of the correction is applied, in [0, 1]."""


@dataclass(frozen=True)
class FluxOptions:
    """The paper's image model: FLUX.1-schnell fine-tuned on pairs (Sec. 5)."""

    name: ClassVar[str] = "flux"

    weights: str | None = None
    """Folder or hub id of the weights, such as nviolante/dot3d/image-mask; must be given."""
    base: str | None = None
    """Folder or hub id of the model that the weights were trained from, for the parts that they lack."""
    lora: Path | None = None
    """A low-rank adaptation (lora.safetensors) to merge into the weights."""
    variant: Literal["auto", "image-mask", "image-background"] = "auto"
    """The network's input beside the composite; auto reads it from the weights' folder."""
    seed: int = 0
    """Of the noise; the same for all views."""
    sampling_steps: int = 4
    """Steps of the diffusion sampling."""
    strength: float = 1.0
    """How far the object's material may change, in [0, 1]; 0 lets only its light change."""
    detail: float = 0.0
    """In [0, 1]: 1 applies the network's light to the composite's own pixels, 0 keeps the network's pixels."""
    precision: Literal["auto", "bf16", "fp8", "nf4", "offload", "float32"] = "auto"
    """Of the weights; auto takes the best that fits the free memory."""
    batch: int = 1
    """Views per pass."""
    compile: bool = False
    """Compile the network first; worth it from about twenty views on."""


HarmonizerOptions = NoneOptions | CompactOptions | FluxOptions
"""Options of the methods that `harmonize` offers; other packages bring classes with a method `make(context)`."""


def _ignore(sentence: str) -> None:
    """Discard a sentence."""


@dataclass(frozen=True)
class HarmonizerContext:
    """Where a harmoniser runs and how much it will be asked to do."""

    device: torch.device = torch.device("cpu")  # noqa: RUF009
    """Where the network runs."""
    views: int = 1
    """How many views will be harmonised: the price of a service."""
    pixels: int = 704 * 496
    """Pixels per view: the memory of a network."""
    key: str | None = None
    """Of a service that asks for one."""
    strengths: tuple[float, ...] = (1.0,)
    """Noise levels that views will be started from, in (0, 1]."""
    say: Callable[[str], None] = _ignore
    """Takes messages for the user, one line each."""
