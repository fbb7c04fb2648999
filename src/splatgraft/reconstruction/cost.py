"""Predicts the peak memory and the time of a reconstruction from its options."""

from pathlib import Path

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.spherical_harmonics import coefficient_count
from splatgraft.reconstruction.options import ReconstructOptions

_BASE_BYTES = 450 * 2**20
"""Python, torch and compiled kernels, resident."""
_COPIES = 6
"""Copies of every field: value, gradient, two moments, and two while Gaussians are rearranged."""
_BYTES_PER_PIXEL = 160
"""For the largest view while it is rendered and compared: colour, transmittance, loss and their gradients."""
_BYTES_PER_GAUSSIAN = 1500
"""Projections, tile lists and their gradients."""

# CPU seconds of one step; fitted to runs of 1000 to 4000 steps on an AMD EPYC at 3 GHz (docs/results.md)
_STEP_SECONDS = 6e-3
_SECONDS_PER_GAUSSIAN = 1.0e-6
"""Projection, colours, Adam."""
_SECONDS_PER_PIXEL = 0.3e-6
"""Blending and loss."""
_ERROR_SHARE = 0.1
"""Share of all this that measuring the covered error adds."""


def predict_memory(capture: PosedImages, options: ReconstructOptions) -> int:
    """Upper estimate of the peak memory of the process that calls `reconstruct`, bytes.

    Measured on the CPU with bands up to degree 3: 20k Gaussians at 352x248 took 492 MiB (534 predicted), 200k 974
    (1035), 40k at 640x426 568 (626).
    """
    served = options.served(capture)
    pixels = served.cameras.sizes.prod(1).double().tolist()
    pyramid = 3 * sum(pixels) * sum(part.factor**2 for part in options.sampling(served.cameras))
    largest = max(pixels, default=0.0)
    largest_file = max(capture.cameras.sizes.prod(1).tolist(), default=0)
    numbers = 11 + 3 * coefficient_count(options.sh_degree)
    gaussians = options.max_gaussians * (4 * numbers * _COPIES + _BYTES_PER_GAUSSIAN)
    decoding = 24 * max(largest_file, largest)
    return int(_BASE_BYTES + pyramid + max(decoding, largest * _BYTES_PER_PIXEL) + gaussians)


def require_memory(capture: PosedImages, options: ReconstructOptions) -> None:
    """Raise a ValueError that names the options to lower where less memory is available than predicted."""
    needed, free = predict_memory(capture, options), available_memory(options.device)
    if free is not None and needed > free:
        raise ValueError(
            f"reconstruct: expected {needed / 2**30:.1f} GiB of free memory, found {free / 2**30:.1f} GiB; "
            f"lower --resolution or --budget ({options.max_gaussians})"
        )


def available_memory(device: str) -> int | None:
    """Bytes available on `device` without swapping; None where the system does not report them (Linux and CUDA do)."""
    if device.startswith("cuda"):
        return torch.cuda.mem_get_info(torch.device(device))[0]
    found = []
    if (table := Path("/proc/meminfo")).exists():
        rows = dict(line.split(":", 1) for line in table.read_text().splitlines())
        found.append(int(rows["MemAvailable"].split()[0]) * 1024)
    # a container's limit (cgroup v2)
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if limit.exists() and limit.read_text().strip() != "max":
        found.append(max(int(limit.read_text()) - int(used.read_text()), 0))
    return min(found, default=None)


def predict_cpu_seconds(cameras: Cameras, options: ReconstructOptions) -> float:
    """CPU seconds of `reconstruct`, within about a factor of 2: scenes differ in how many Gaussians a pixel sees."""
    served = cameras.resized(options.served_size(cameras))
    sizes = served.sizes.prod(1).double()
    size = float(sizes.mean()) if len(sizes) else 0.0
    pixels, begin = 0.0, 0.0
    for part in options.sampling(served):
        pixels += (part.until - begin) * size * (part.factor / part.stride) ** 2
        begin = part.until
    # about a sixth fewer than the budget on average, as it is reached late
    gaussians = options.max_gaussians * 5 / 6
    step = _STEP_SECONDS + _SECONDS_PER_GAUSSIAN * gaussians + _SECONDS_PER_PIXEL * pixels
    return options.all_iterations * step * (1 + _ERROR_SHARE * options.splits_by_error)


def describe_duration(seconds: float) -> str:
    """Rounded as what it is, an estimate: '40 s', '6 minutes' or '1.5 hours'."""
    if seconds < 90:
        return f"{max(1, round(seconds / 10)) * 10} s"
    if seconds < 5400:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours"
