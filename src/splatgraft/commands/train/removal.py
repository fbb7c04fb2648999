"""The command `train removal`: pairs become a network that takes objects out of pictures (paper, Sec. 5.2 and 5.3)."""

from dataclasses import dataclass, field

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.workflow.flux_training import RemovalTrainingOptions, train_removal


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


COMMAND = TrainRemoval
