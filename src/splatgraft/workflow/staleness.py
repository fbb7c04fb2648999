"""Which steps of a project are stale, and why."""

from splatgraft.project.record import why_stale
from splatgraft.project.step import job_of
from splatgraft.workflow.flow import Flow


def reasons(flow: Flow) -> dict[str, str | None]:
    """The reason why each step is stale, or None; a step after a stale step waits for that step."""
    found: dict[str, str | None] = {}
    for name, step in flow:
        waits = [other for other in flow.before(name) if found[other] is not None]
        found[name] = f"waits for {waits[0]}" if waits else why_stale(job_of(step))
    return found
