"""Options of a reconstruction, and the presets of each quality."""

from dataclasses import dataclass, replace
from typing import Literal

from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.spherical_harmonics import MAX_DEGREE

Quality = Literal["draft", "standard", "high", "full"]


@dataclass(frozen=True)
class Sampling:
    """Which pixels the steps of a part of a fit see."""

    factor: float
    """On the size of the photographs, which are averaged."""
    stride: int
    """Every how many pixels along each axis one is fitted, without averaging; which one changes with every visit."""
    until: float
    """Share of the steps after which the next entry holds."""


SPARSE = (Sampling(0.35, 1, 0.4), Sampling(1.0, 2, 1.0))
"""A quarter of the pixels gives as good a step as all of them (docs/results.md)."""
DENSE = (Sampling(0.5, 1, 0.3), Sampling(0.7071, 1, 0.6), Sampling(1.0, 1, 1.0))
"""For a GPU, where pixels are cheap, and for small photographs."""
EVERY_PIXEL = (Sampling(1.0, 1, 1.0),)


@dataclass(frozen=True)
class _Preset:
    iterations: int
    budget: int
    longest_side_px: int
    sampling: tuple[Sampling, ...] = SPARSE
    beyond_draft: bool = False
    """Whether backgrounds are drawn by chance, the start has a far shell, and splits look at covered errors: `draft`
    has none of them, since the numbers of the light estimate were fitted on draft scenes."""


_PRESETS: dict[str, _Preset] = {
    "draft": _Preset(1_000, 25_000, 640),
    "standard": _Preset(4_000, 100_000, 960, beyond_draft=True),
    "high": _Preset(10_000, 100_000, 960, beyond_draft=True),
    # 3DGS's length and the usual size of images
    "full": _Preset(30_000, 1_000_000, 1600, EVERY_PIXEL, beyond_draft=True),
}


@dataclass(frozen=True)
class ReconstructOptions:
    """Length, size and seed of a reconstruction; None takes the value of the quality."""

    quality: Quality = "standard"
    """`draft`: 1000 steps, 25k Gaussians; `standard`: 4000, 100k; `high`: 10000, 100k; `full`:
    30000, 1M, every pixel (for GPUs)."""
    iterations: int | None = None
    """Steps, one view each; every schedule scales with it."""
    budget: int | None = None
    """Upper bound of the number of Gaussians, never exceeded."""
    resolution: float | None = None
    """Factor on the size of the images; None: longest side 640 (draft), 960 (standard, high) or 1600 px (full)
    at most."""
    sh_degree: int = 3
    """Highest band of the colours; bands come in one by one during the first tenth of the steps."""
    photo_colors: bool | None = None
    """Whether each photo has its own exposure and white balance, which then stay out of the scene; None: where its EXIF
    says that they differ."""
    random_background: bool | None = None
    """Whether each step draws the scene over another colour, so that dark surfaces are not fitted by holes before
    `background`; None: unless at `draft`, or the photos show an object alone before `background`."""
    far_shell: bool | None = None
    """Whether the start has Gaussians behind everything, in the colours around; None: likewise."""
    eval_every: int = 0
    """Every how many views one is held out, from the first (3DGS: 8); 0 holds out none."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """sRGB behind the scene."""
    seed: int = 0
    """Seed of the order of views and of everything that is drawn by chance."""
    device: str = "cpu"
    """`cpu` or `cuda`."""

    def __post_init__(self) -> None:
        """Raises: ValueError where a number is out of range."""
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
        """Number of steps, given or of the quality."""
        return _PRESETS[self.quality].iterations if self.iterations is None else self.iterations

    @property
    def max_gaussians(self) -> int:
        """The budget, given or of the quality."""
        return _PRESETS[self.quality].budget if self.budget is None else self.budget

    @property
    def splits_by_error(self) -> bool:
        """Whether Gaussians are split by gradient and covered error, not by the gradient alone."""
        return _PRESETS[self.quality].beyond_draft

    def decided(self, surroundings: bool) -> "ReconstructOptions":
        """The same options with the choices made that the quality and the photos decide.

        Args:
            surroundings: Whether the photos show what is around, and not an object alone before `background`.
        """
        usual = _PRESETS[self.quality].beyond_draft and surroundings
        return replace(
            self,
            random_background=usual if self.random_background is None else self.random_background,
            far_shell=usual if self.far_shell is None else self.far_shell,
        )

    def sampling(self, served: Cameras) -> tuple[Sampling, ...]:
        """Which pixels of the served views the steps see, from the first to the last.

        Pixels are left out only as long as a step still sees as many pixels as there are Gaussians: on a room at
        352x248 with 25k Gaussians, which has fewer, every second pixel costs half a decibel.
        """
        sampling = _PRESETS[self.quality].sampling
        sizes = served.sizes.prod(1).double()
        seen = (float(sizes.mean()) if len(sizes) else 0.0) / max(part.stride for part in sampling) ** 2
        return DENSE if sampling is SPARSE and seen < self.max_gaussians else sampling

    def served(self, capture: PosedImages) -> PosedImages:
        """The capture, resampled to the size at which it is fitted."""
        return capture.resized(self.served_size(capture.cameras))

    def served_size(self, cameras: Cameras) -> float:
        """The factor by which images are resampled to the size at which they are fitted."""
        if self.resolution is not None:
            return self.resolution
        longest = int(cameras.sizes.max()) if len(cameras) else 1
        return min(1.0, _PRESETS[self.quality].longest_side_px / longest)
