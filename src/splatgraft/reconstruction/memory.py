"""Predicts the peak memory of a reconstruction from its options, and reads how much is available."""

import os
from pathlib import Path

import torch

from splatgraft.core.posed_images import PosedImages
from splatgraft.core.spherical_harmonics import coefficient_count
from splatgraft.reconstruction.options import ReconstructOptions

_BASE = 450 * 2**20
"""Python, torch and compiled kernels, resident."""
_COPIES = 6
"""Copies of every field: value, gradient, two moments, and two while Gaussians are rearranged."""
_BYTES_PER_PIXEL = 160
"""For the largest view while it is rendered and compared: colour, transmittance, loss and their gradients."""
_BYTES_PER_GAUSSIAN = 1500
"""Projections, tile lists and their gradients."""


def predict_memory(capture: PosedImages, options: ReconstructOptions) -> int:
    """Upper estimate of the peak memory of the process that calls `reconstruct`, bytes.

    Measured on the CPU with bands up to degree 3: 20k Gaussians at 352x248 took 492 MiB (534 predicted), 200k 974
    (1035), 40k at 640x426 568 (626).
    """
    served = options.served(capture)
    pixels = served.cameras.sizes.prod(1).double().tolist()
    pyramid = 3 * sum(pixels) * sum(part.factor**2 for part in options.sampling(served.cameras))
    largest = max(pixels, default=0.0)
    numbers = 11 + 3 * coefficient_count(options.sh_degree)
    gaussians = options.most_gaussians * (4 * numbers * _COPIES + _BYTES_PER_GAUSSIAN)
    decoding = 24 * max(_file_pixels(capture), largest)
    return int(_BASE + pyramid + max(decoding, largest * _BYTES_PER_PIXEL) + gaussians)


def _file_pixels(capture: PosedImages) -> float:
    return float(capture.cameras.sizes.prod(1).max()) if len(capture) else 0.0


def require_memory(capture: PosedImages, options: ReconstructOptions) -> None:
    """Check the predicted memory against the available memory.

    Raises:
        ValueError: Where too little is available; names the options to lower.
    """
    needed, free = predict_memory(capture, options), available_memory(options.device)
    if free is not None and needed > free:
        raise ValueError(
            f"reconstruct: expected {needed / 2**30:.1f} GiB of free memory, found {free / 2**30:.1f} GiB; "
            f"lower --resolution or --budget ({options.most_gaussians})"
        )


def available_memory(device: str) -> int | None:
    """Bytes available on `device` without swapping; None where the system does not report them."""
    if device.startswith("cuda"):
        return torch.cuda.mem_get_info(torch.device(device))[0]
    found = [value for value in (_meminfo_available(), _control_group_free()) if value is not None]
    if found:
        return min(found)
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None


def _meminfo_available() -> int | None:
    table = Path("/proc/meminfo")
    if not table.exists():
        return None
    rows = dict(line.split(":", 1) for line in table.read_text().splitlines() if ":" in line)
    return int(rows["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in rows else None


def _control_group_free() -> int | None:
    """Bytes left under a container's memory limit (cgroup v2)."""
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if not (limit.exists() and used.exists()) or limit.read_text().strip() == "max":
        return None
    return max(int(limit.read_text()) - int(used.read_text()), 0)
