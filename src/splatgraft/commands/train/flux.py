"""The command `train flux`: pairs become a harmoniser of FLUX.1-schnell (paper, Sec. 4)."""

from dataclasses import dataclass, field
from typing import Literal

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.training.loop_options import LoopOptions
from splatgraft.workflow.training_data import DataOptions


@dataclass(frozen=True)
class TrainFlux:
    """Train the paper's harmoniser; goes on where it was killed. Many GPUs: `accelerate launch -m splatgraft train`."""

    out: Positional
    """Folder for the model, states, log and validation pictures."""
    base: str = "black-forest-labs/FLUX.1-schnell"
    """Folder or hub id with transformer/ and vae/; a harmoniser's folder goes on training that one."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=LoopOptions)
    condition: Literal["image-mask", "image-background"] = "image-mask"
    """What joins the composite: the object's mask (the paper) or the scene without it."""
    first_layer: Literal["repeat", "zero"] = "repeat"
    """How the first layer is widened: by its own weights (the paper) or by zeros."""
    lora: int = 0
    """Rank of a low-rank adaptation; 0 trains all weights."""
    times: Literal["uniform", "logit-normal", "schnell"] = "uniform"
    """Which noise levels are trained: all alike, the middle ones more, or the four that are used."""
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice: faster, several times the memory."""
    force: bool = False
    """Begin although the prediction says that memory will not do."""

    def execute(self, console: Console) -> int:
        """Train."""
        from splatgraft.workflow.flux_training import train_flux

        return train_flux(self, console)
