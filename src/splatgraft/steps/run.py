"""The command `run`: everything in a project that is stale, in order."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.project import clear_leftovers, locked, why_stale
from splatgraft.steps.capture import Capture, doubt_about
from splatgraft.steps.flow import read_flow
from splatgraft.steps.step import Positional, job_of, perform
from splatgraft.steps.terminal import Terminal


@dataclass(frozen=True)
class Run:
    """Do what is stale in a project; a step that was killed goes on from its last checkpoint."""

    project: Positional = Path("project.toml")
    """The project file, or its folder."""
    out: Path | None = None
    """Where all results go; the folder of the project file where not given."""
    to: str | None = None
    """Stop after this step (reconstruct, or source/reconstruct for one of the two)."""
    force: tuple[str, ...] = ()
    """Do these steps even where they are fresh."""
    accept_doubtful: bool = False
    """Go on after a capture whose poses are not plausible, as accept_doubtful = true in [source] or [target] does."""

    def execute(self, terminal: Terminal) -> int:
        """Do the steps; the paths of what was wanted are the last lines of standard output.

        Raises:
            ValueError: Where the poses of a capture are not plausible and this was not accepted.
        """
        flow = read_flow(self.project, self.out)
        wanted = flow.up_to(self.to)
        forced = {step for name in self.force for step in flow.named(name)}
        with locked(flow.layout.root / "project"):
            for name, step in wanted.items():
                reason = "asked for" if name in forced else why_stale(job_of(step))
                terminal.say(f"{name:<20} {reason or 'up to date'}")
                if reason:
                    perform(step, terminal, name=name)
                else:
                    clear_leftovers(step.out)
                if isinstance(step, Capture) and not self.accept_doubtful and (doubt := doubt_about(step)):
                    raise ValueError(doubt)
        terminal.say("results:")
        for name, path in flow.results():
            if name in wanted:
                terminal.result(path)
        return 0


COMMAND = Run
