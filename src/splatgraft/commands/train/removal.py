"""The command `train removal`: pairs become a network that takes objects out of pictures (paper, Sec. 4.2 and 4.3)."""

from dataclasses import dataclass, field

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.training.loop_options import LoopOptions
from splatgraft.workflow.training_data import DataOptions


@dataclass(frozen=True)
class TrainRemoval:
    """Train the object removal on Stable Diffusion 2 (v-prediction); goes on where it was killed."""

    out: Positional
    """Folder for the model, states, log and validation pictures."""
    base: str = "stabilityai/stable-diffusion-2"
    """Folder or hub id with unet/ and vae/."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=lambda: LoopOptions(steps=260_000, batch=8, rate=1e-5))
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice: faster, several times the memory."""
    force: bool = False
    """Begin although the prediction says that memory will not do."""

    def execute(self, console: Console) -> int:
        """Train."""
        from splatgraft.workflow.flux_training import train_removal

        return train_removal(self, console)
