"""Time estimate of the steps of a run, from their earlier runs, or else from typical times of such steps."""

from collections.abc import Iterable, Sequence

from splatgraft.editor.jobs.jobs import PlannedStep
from splatgraft.project.record import read_record
from splatgraft.project.step import Step
from splatgraft.workflow.flow import Flow

_TYPICAL_SECONDS = {
    "capture": 1.0,
    "adopt": 0.2,
    "reconstruct": 56.0,
    "segment": 6.0,
    "compose": 0.2,
    "relight": 15.0,
    "render": 6.0,
    "harmonize": 1.1,
    "consolidate": 2.0,
    "evaluate": 3.0,
}
"""Seconds in a first `splatgraft demo` on two cores, compilation of kernels included.

Another project differs by a factor, which its finished steps give."""


def estimate_step_times(flow: Flow, stale: Iterable[str]) -> tuple[PlannedStep, ...]:
    """Estimate the seconds of each step.

    Args:
        flow: All steps of the project; finished ones give the factor to the typical times.
        stale: Names of the steps that will run.

    Returns:
        One entry per stale step; `is_measured` is false where the seconds are a guess.
    """
    measured = {name: found.seconds for name, step in flow if (found := read_record(step.out)) is not None}
    typical = {name: _TYPICAL_SECONDS[_kind(step)] for name, step in flow}
    known = [name for name in measured if measured[name] > 0]
    factor = sum(measured[name] for name in known) / sum(typical[name] for name in known) if known else 1.0
    return tuple(
        PlannedStep(name, measured[name], True)
        if name in measured
        else PlannedStep(name, factor * typical[name], False)
        for name in stale
    )


def describe_estimate(planned: Sequence[PlannedStep]) -> str:
    """One line on how many steps will run and how long they take."""
    seconds = sum(step.seconds for step in planned)
    duration = f"{max(1, round(seconds / 5)) * 5:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} minutes"
    measured = all(step.is_measured for step in planned)
    basis = "as before" if measured else "a guess from the demo on two cores"
    return f"{len(planned)} step{'s' if len(planned) > 1 else ''} to run: about {duration} ({basis})"


def _kind(step: Step) -> str:
    return type(step).__name__.lower()
