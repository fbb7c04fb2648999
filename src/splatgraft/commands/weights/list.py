"""The command `weights list`: every model that the package loads, and whether its weights are here."""

from dataclasses import dataclass

from splatgraft.runtime.console import Console
from splatgraft.runtime.weights.catalogue import CATALOGUE, ModelWeights
from splatgraft.runtime.weights.store import folder_of, home, is_stored


@dataclass(frozen=True)
class WeightsList:
    """Say which models there are, what they are for, their licences and sizes, and what is fetched already."""

    def execute(self, console: Console) -> int:
        """Print two lines per model."""
        for model in CATALOGUE:
            state = "here" if is_stored(folder_of(model.repository or model.name), model) else "not fetched"
            console.result(f"{model.name:<32} {_size(model):>9}  {state:<12} {model.purpose}")
            note = f"; {model.note}" if model.note else ""
            console.result(f"{'':<32} {model.repository or model.urls[0]}; {model.licence}; {_access(model)}{note}")
        console.say(f"they are kept in {home()}; a folder of it can be copied to a machine without a network")
        return 0


def _size(model: ModelWeights) -> str:
    return "size ?" if model.gigabytes is None else f"{model.gigabytes:g} GB"


def _access(model: ModelWeights) -> str:
    return {True: "gated", False: "free access", None: "access not known"}[model.gated]


COMMAND = WeightsList
