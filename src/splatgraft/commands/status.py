"""The command `status`: which steps of a project are done, which are stale and why."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.project.record import Record, read_record
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.workflow.flow import read_flow, reasons


@dataclass(frozen=True)
class Status:
    """Say for every step of a project whether its result is up to date, and if not, why."""

    project: Positional = Path("project.toml")
    """The project file, or its folder."""
    out: Path | None = None
    """Folder of all results; the folder of the project file if not given."""

    def execute(self, console: Console) -> int:
        """Print one line per step."""
        flow = read_flow(self.project, self.out)
        console.result(f"{'step':<20} {'seconds':>8} {'memory':>9}  state")
        for name, reason in reasons(flow).items():
            seconds, memory = _cost(read_record(flow.steps[name].out))
            console.result(f"{name:<20} {seconds:>8} {memory:>9}  {f'stale: {reason}' if reason else 'up to date'}")
        return 0


def _cost(record: Record | None) -> tuple[str, str]:
    return (f"{record.seconds:.1f}", record.memory) if record else ("", "")


COMMAND = Status
