"""The command `train flux`: pairs become a harmoniser of FLUX.1-schnell (paper, Sec. 5)."""

from collections.abc import Callable
from dataclasses import dataclass, field

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft_paper.training.flux_training import FluxTrainingOptions, train_flux
from splatgraft_paper.training.training_recipe import arguments_with_recipe


@dataclass(frozen=True)
class TrainFlux:
    """Train the paper's harmoniser; a killed run is continued. Many GPUs: `torchrun -m splatgraft train`."""

    out: Positional
    """Folder for the model, states, log and validation pictures."""
    options: FluxTrainingOptions = field(default_factory=FluxTrainingOptions)

    def execute(self, console: Console) -> int:
        """Train, and print the folder of the model."""
        model = train_flux(self.out, self.options, console)
        if model is not None:
            console.result(model)
        return 0


def current_arguments(words: list[str], say: Callable[[str], None]) -> list[str]:
    """Put the options of --recipe before the user's own words."""
    return arguments_with_recipe("train flux", words)


COMMAND = TrainFlux
