"""The command `weights fetch`: the weights of one model, into the folder where the other commands look."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatgraft.runtime.console import Console
from splatgraft.runtime.weights.catalogue import find_model
from splatgraft.runtime.weights.hub import fetch
from splatgraft.runtime.weights.store import folder_of


@dataclass(frozen=True)
class WeightsFetch:
    """Fetch what a model needs, and no more; an interrupted fetch continues, and every file is compared by its hash."""

    name: Annotated[str, tyro.conf.Positional]
    """As `splatgraft weights list` names it."""
    to: Path | None = None
    """Folder for the files; where the other commands look, unless given."""

    def execute(self, console: Console) -> int:
        """Fetch, and print the folder."""
        model = find_model(self.name)
        folder = self.to or folder_of(model.repository or model.name)
        fetch(model, folder, say=console.say)
        console.result(folder / model.folder)
        return 0


COMMAND = WeightsFetch
