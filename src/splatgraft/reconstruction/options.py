"""Options of a reconstruction, the presets of each quality, and predictions of memory and time."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.spherical_harmonics import MAX_DEGREE, coefficient_count

Quality = Literal["draft", "standard", "high", "full"]


@dataclass(frozen=True)
class Sampling:
    """Pixels that are fitted during a part of the steps."""

    factor: float
    """Factor on the size of the photographs, which are reduced by averaging."""
    stride: int
    """Distance of fitted pixels along each axis, without averaging; the first pixel changes with every visit."""
    until: float
    """Share of the steps at which this part ends."""


SPARSE = (Sampling(0.35, 1, 0.4), Sampling(1.0, 2, 1.0))
"""Default schedule: a quarter of the pixels gives as good a step as all of them (docs/results.md)."""
DENSE = (Sampling(0.5, 1, 0.3), Sampling(0.7071, 1, 0.6), Sampling(1.0, 1, 1.0))
"""Coarse-to-fine schedule with all pixels, for small photographs."""
EVERY_PIXEL = (Sampling(1.0, 1, 1.0),)
"""Full photographs at every step, for a GPU, which renders pixels cheaply."""


@dataclass(frozen=True)
class _Preset:
    iterations: int
    budget: int
    longest_side_px: int
    sampling: tuple[Sampling, ...] = SPARSE


_PRESETS: dict[str, _Preset] = {
    "draft": _Preset(1_000, 25_000, 640),
    "standard": _Preset(4_000, 100_000, 960),
    "high": _Preset(10_000, 100_000, 960),
    # 3DGS's length and the usual size of images
    "full": _Preset(30_000, 1_000_000, 1600, EVERY_PIXEL),
}


@dataclass(frozen=True)
class ReconstructOptions:
    """Length, size and seed of a reconstruction; None takes the preset of the quality."""

    quality: Quality = "standard"
    """`draft`: 1000 steps, 25k Gaussians; `standard`: 4000, 100k; `high`: 10000, 100k; `full`:
    30000, 1M, every pixel (for GPUs)."""
    iterations: int | None = None
    """Steps, one view each; every schedule scales with this number."""
    budget: int | None = None
    """Largest number of Gaussians, never exceeded."""
    resolution: float | None = None
    """Factor on the size of the images; None: longest side 640 (draft), 960 (standard, high) or 1600 px (full)
    at most."""
    sh_degree: int = 3
    """Highest band of the colours; bands are added one by one during the first tenth of the steps."""
    photo_colors: bool | None = None
    """Whether each photo has its own exposure and white balance, which then stay out of the scene; None: if their EXIF
    data differ in them."""
    eval_every: int = 0
    """Distance of held-out views, from the first view on (3DGS: 8); 0 holds out none."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the scene, sRGB in [0, 1]."""
    seed: int = 0
    """Seed of the order of views and of all random choices."""
    device: str = "cpu"
    """`cpu` or `cuda`."""

    def __post_init__(self) -> None:
        """Raise a ValueError if a number is out of range."""
        for name, low in (("iterations", 1), ("budget", 1), ("eval_every", 0)):
            value = getattr(self, name)
            if value is not None and value < low:
                raise ValueError(f"reconstruct: expected {name} of at least {low}, found {value}")
        if not 0 <= self.sh_degree <= MAX_DEGREE:
            raise ValueError(f"reconstruct: expected sh_degree from 0 to {MAX_DEGREE}, found {self.sh_degree}")
        if self.resolution is not None and not 0 < self.resolution <= 1:
            raise ValueError(f"reconstruct: expected resolution in (0, 1], found {self.resolution}")
        if self.eval_every == 1:
            raise ValueError(
                "reconstruct: expected eval_every of 0 or at least 2, found 1, which leaves no view to fit"
            )

    @property
    def all_iterations(self) -> int:
        """Number of steps, given or from the preset."""
        return _PRESETS[self.quality].iterations if self.iterations is None else self.iterations

    @property
    def max_gaussians(self) -> int:
        """Largest number of Gaussians, given or from the preset."""
        return _PRESETS[self.quality].budget if self.budget is None else self.budget

    def sampling(self, served: Cameras) -> tuple[Sampling, ...]:
        """Return the schedule of the fitted pixels for the served views.

        Pixels are skipped only if a step still has at least one pixel per Gaussian. On a room at 352x248 with 25k
        Gaussians, which has fewer, fitting every second pixel costs half a decibel.
        """
        sampling = _PRESETS[self.quality].sampling
        sizes = served.sizes.prod(1).double()
        seen = (float(sizes.mean()) if len(sizes) else 0.0) / max(part.stride for part in sampling) ** 2
        return DENSE if sampling is SPARSE and seen < self.max_gaussians else sampling

    def served(self, capture: PosedImages) -> PosedImages:
        """Resample the capture to the size at which it is fitted."""
        return capture.resized(self.served_size(capture.cameras))

    def served_size(self, cameras: Cameras) -> float:
        """Compute the factor from the size of the images to the size at which they are fitted."""
        if self.resolution is not None:
            return self.resolution
        longest = int(cameras.sizes.max()) if len(cameras) else 1
        return min(1.0, _PRESETS[self.quality].longest_side_px / longest)


_BASE_BYTES = 450 * 2**20  # python, torch and compiled kernels, resident
_COPIES = 6  # copies of every field: value, gradient, two moments, and two while Gaussians are rearranged
_BYTES_PER_PIXEL = 160  # of the largest view: colour, transmittance, loss and their gradients
_BYTES_PER_GAUSSIAN = 1500  # projections, tile lists and their gradients

# CPU seconds of one step; fitted to runs of 1000 to 4000 steps on an AMD EPYC at 3 GHz (docs/results.md)
_STEP_SECONDS = 6.6e-3
_SECONDS_PER_GAUSSIAN = 1.1e-6  # projection, colours, Adam
_SECONDS_PER_PIXEL = 0.33e-6  # blending and loss


def predict_memory(capture: PosedImages, options: ReconstructOptions) -> int:
    """Predict an upper bound of the peak memory of the process that calls `reconstruct`, bytes.

    Measured on the CPU with bands up to degree 3: 20k Gaussians at 352x248 took 492 MiB (534 predicted), 200k took 974
    (1035), and 40k at 640x426 took 568 (626).
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
    """Raise a ValueError that names the options to lower if less memory is available than predicted."""
    needed, free = predict_memory(capture, options), available_memory(options.device)
    if free is not None and needed > free:
        raise ValueError(
            f"reconstruct: expected {needed / 2**30:.1f} GiB of free memory, found {free / 2**30:.1f} GiB; "
            f"lower --resolution or --budget ({options.max_gaussians})"
        )


def available_memory(device: str) -> int | None:
    """Return the bytes available on `device` without swapping; None if the system does not report them.

    Linux and CUDA report them.
    """
    if device.startswith("cuda"):
        return torch.cuda.mem_get_info(torch.device(device))[0]
    found = []
    if (table := Path("/proc/meminfo")).exists():
        rows = dict(line.split(":", 1) for line in table.read_text(encoding="utf-8").splitlines())
        found.append(int(rows["MemAvailable"].split()[0]) * 1024)
    # a container's limit (cgroup v2)
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if limit.exists() and limit.read_text(encoding="utf-8").strip() != "max":
        found.append(max(int(limit.read_text(encoding="utf-8")) - int(used.read_text(encoding="utf-8")), 0))
    return min(found, default=None)


def predict_cpu_seconds(cameras: Cameras, options: ReconstructOptions) -> float:
    """Predict the CPU seconds of `reconstruct`, within about a factor of 2.

    Scenes differ in the number of Gaussians per pixel.
    """
    served = cameras.resized(options.served_size(cameras))
    sizes = served.sizes.prod(1).double()
    size = float(sizes.mean()) if len(sizes) else 0.0
    pixels, begin = 0.0, 0.0
    for part in options.sampling(served):
        pixels += (part.until - begin) * size * (part.factor / part.stride) ** 2
        begin = part.until
    # on average about a sixth less than the budget, which is reached late
    gaussians = options.max_gaussians * 5 / 6
    step = _STEP_SECONDS + _SECONDS_PER_GAUSSIAN * gaussians + _SECONDS_PER_PIXEL * pixels
    return options.all_iterations * step


def describe_duration(seconds: float) -> str:
    """Round an estimate for people: '40 s', '6 minutes' or '1.5 hours'."""
    if seconds < 90:
        return f"{max(1, round(seconds / 10)) * 10} s"
    if seconds < 5400:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours"
