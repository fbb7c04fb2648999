"""The command `train removal`: pairs become a network that takes objects out of pictures (paper, Sec. 5.2 and 5.3)."""

from collections.abc import Callable
from dataclasses import dataclass, field

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft_paper.training.flux_training import RemovalTrainingOptions, train_removal
from splatgraft_paper.training.training_recipe import arguments_with_recipe


@dataclass(frozen=True)
class TrainRemoval:
    """Train the object removal on Stable Diffusion 2 (v-prediction); a killed run is continued."""

    out: Positional
    """Folder for the model, states, log and validation pictures."""
    options: RemovalTrainingOptions = field(default_factory=RemovalTrainingOptions)

    def execute(self, console: Console) -> int:
        """Train, and print the folder of the model."""
        model = train_removal(self.out, self.options, console)
        if model is not None:
            console.result(model)
        return 0


def current_arguments(words: list[str], say: Callable[[str], None]) -> list[str]:
    """Put the options of --recipe before the user's own words."""
    return arguments_with_recipe("train removal", words)


COMMAND = TrainRemoval
