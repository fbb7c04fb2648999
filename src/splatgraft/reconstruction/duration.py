"""Predicts how long a reconstruction takes on the CPU, from its options and the size of the photographs."""

from dataclasses import dataclass

from splatgraft.core.cameras import Cameras
from splatgraft.reconstruction.options import ReconstructOptions


@dataclass(frozen=True)
class StepCost:
    """CPU seconds of one step; fitted to runs of 1000 to 4000 steps on an AMD EPYC at 3 GHz (docs/results.md)."""

    fixed: float = 6e-3
    """Whatever the size."""
    gaussian: float = 1.0e-6
    """Per Gaussian: projection, colours, Adam."""
    pixel: float = 0.3e-6
    """Per pixel: blending and loss."""
    error: float = 0.1
    """Share of all this that measuring the covered error adds."""


def predict_cpu_seconds(cameras: Cameras, options: ReconstructOptions, cost: StepCost = StepCost()) -> float:
    """CPU seconds of `reconstruct`, within about a factor of 2: scenes differ in how many Gaussians a pixel sees.

    Args:
        cameras: Of the capture that is given to `reconstruct`.
        options: Likewise.
        cost: Of a step.
    """
    served = cameras.resized(options.served_size(cameras))
    sizes = served.sizes.prod(1).double()
    size = float(sizes.mean()) if len(sizes) else 0.0
    pixels, begin = 0.0, 0.0
    for part in options.sampling(served):
        pixels += (part.until - begin) * size * (part.factor / part.stride) ** 2
        begin = part.until
    # about a sixth fewer than the budget on average, as it is reached late
    gaussians = options.most_gaussians * 5 / 6
    step = cost.fixed + cost.gaussian * gaussians + cost.pixel * pixels
    return options.all_iterations * step * (1 + cost.error * options.splits_by_error)


def describe_duration(seconds: float) -> str:
    """Rounded as what it is, an estimate: '40 s', '6 minutes' or '1.5 hours'."""
    if seconds < 90:
        return f"{max(1, round(seconds / 10)) * 10} s"
    if seconds < 5400:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours"
