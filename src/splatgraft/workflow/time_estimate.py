"""How long each step of a run will take, before it has begun: as it took last time, or as such steps usually do.

Measures nothing; a guess is marked as one.
"""

from collections.abc import Iterable

from splatgraft.editor.jobs.jobs import PlannedStep
from splatgraft.project.record import read_record
from splatgraft.project.step import Step
from splatgraft.workflow.flow import Flow

_USUAL = {
    "capture": 1.0,
    "adopt": 0.2,
    "reconstruct": 28.0,
    "segment": 4.3,
    "compose": 0.2,
    "relight": 2.7,
    "render": 3.7,
    "harmonize": 1.1,
    "consolidate": 0.8,
    "evaluate": 1.7,
}
"""Seconds, of `make demo` on two cores. Other projects differ by a factor, which measured steps tell."""


def estimate_step_times(flow: Flow, stale: Iterable[str]) -> tuple[PlannedStep, ...]:
    """The steps in `stale`, each with the seconds that it will roughly take."""
    measured = {name: found.seconds for name, step in flow if (found := read_record(step.out)) is not None}
    usual = {name: _USUAL[_kind(step)] for name, step in flow}
    known = [name for name in measured if measured[name] > 0]
    factor = sum(measured[name] for name in known) / sum(usual[name] for name in known) if known else 1.0
    return tuple(
        PlannedStep(name, measured[name], True) if name in measured else PlannedStep(name, factor * usual[name], False)
        for name in stale
    )


def _kind(step: Step) -> str:
    return type(step).__name__.lower()
