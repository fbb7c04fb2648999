"""The command `status`: what is done in a project, what is stale and why."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.project import Record, read_record, why_stale
from splatgraft.steps.flow import Flow, read_flow
from splatgraft.steps.step import Positional, job_of
from splatgraft.steps.terminal import Terminal


@dataclass(frozen=True)
class Status:
    """Say for every step of a project whether its result stands, and why not."""

    project: Positional = Path("project.toml")
    """The project file, or its folder."""
    out: Path | None = None
    """Where the results are; the folder of the project file where not given."""

    def execute(self, terminal: Terminal) -> int:
        """Print one line per step."""
        flow = read_flow(self.project, self.out)
        terminal.result(f"{'step':<20} {'seconds':>8} {'memory':>9}  state")
        for name, reason in reasons(flow).items():
            seconds, memory = _cost(read_record(flow.steps[name].out))
            terminal.result(f"{name:<20} {seconds:>8} {memory:>9}  {f'stale: {reason}' if reason else 'up to date'}")
        return 0


def reasons(flow: Flow) -> dict[str, str | None]:
    """Why each step is stale, or None; one that waits for a stale one says for which."""
    found: dict[str, str | None] = {}
    for name, step in flow:
        waits = [other for other in flow.before(name) if found[other] is not None]
        found[name] = f"waits for {waits[0]}" if waits else why_stale(job_of(step))
    return found


def _cost(record: Record | None) -> tuple[str, str]:
    return (f"{record.seconds:.1f}", f"{record.peak_memory_bytes / 2**30:.2f} GiB") if record else ("", "")


COMMAND = Status
