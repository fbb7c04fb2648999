"""The command `run`: the stale steps of a project, in order."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.workflow.run import run_steps


@dataclass(frozen=True)
class Run:
    """Perform the stale steps of a project; a killed step continues from its last checkpoint."""

    project: Positional = Path("project.toml")
    """The project file, or its folder."""
    out: Path | None = None
    """Folder of all results; the folder of the project file if not given."""
    to: str | None = None
    """Stop after this step (reconstruct, or source/reconstruct for one of the two)."""
    force: tuple[str, ...] = ()
    """Perform these steps even if they are up to date."""
    accept_doubtful: bool = False
    """Continue after a capture whose poses are not plausible, like accept_doubtful = true in [source] or [target]."""

    def execute(self, console: Console) -> int:
        """Perform the steps; the paths of the results are the last lines of standard output."""
        run_steps(
            self.project,
            console,
            out=self.out,
            to=self.to,
            force=self.force,
            accept_doubtful=self.accept_doubtful,
        )
        return 0


COMMAND = Run
