"""Which steps of a project are stale, and why."""

from collections.abc import Collection

from splatgraft.project.record import why_stale
from splatgraft.project.step import job_of
from splatgraft.workflow.flow import Flow


def reasons(flow: Flow, wanted: Collection[str] | None = None) -> dict[str, str | None]:
    """The reason why each step is stale, or None; a step after a stale step waits for that step.

    Args:
        flow: The steps of a project.
        wanted: Names of the steps to examine, with all steps that they read from; all steps where None. Inputs of
            other steps may be missing.

    Raises:
        ValueError: An input of an examined step is missing.
    """
    found: dict[str, str | None] = {}
    for name, step in flow:
        if wanted is not None and name not in wanted:
            continue
        waits = [other for other in flow.before(name) if found[other] is not None]
        found[name] = f"waits for {waits[0]}" if waits else why_stale(job_of(step))
    return found
