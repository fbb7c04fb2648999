"""What a user may choose about a reconstruction, with the measured presets. Knows nothing about how it is done."""

from dataclasses import dataclass
from typing import Literal

from splatgraft.spherical_harmonics import MAX_DEGREE

Quality = Literal["draft", "standard", "full"]


@dataclass(frozen=True)
class ReconstructOptions:
    """Length, size and seed of a reconstruction; `preset` gives those that were measured."""

    iterations: int = 3000
    """Steps, one view each; every schedule scales with it (3DGS: 30000)."""
    budget: int = 40_000
    """Hard upper bound of the number of Gaussians, at every moment."""
    sh_degree: int = 3
    """Highest band of the colours; bands come in one by one during the first tenth of the steps."""
    resolution: float = 1.0
    """Factor on the size of the images."""
    coarse_to_fine: bool = True
    """Whether the first steps see smaller images."""
    eval_every: int = 0
    """Every how many views one is held out, from the first (3DGS: 8); 0 holds out none."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """sRGB behind the scene."""
    seed: int = 0
    """Of the order of views and everything that is drawn by chance."""
    device: str = "cpu"
    """`cpu` or `cuda`."""

    def __post_init__(self) -> None:
        """Raises: ValueError where a number is out of range."""
        for name, low in (("iterations", 1), ("budget", 1), ("eval_every", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"reconstruct: expected {name} of at least {low}, found {getattr(self, name)}")
        if not 0 <= self.sh_degree <= MAX_DEGREE:
            raise ValueError(f"reconstruct: expected sh_degree from 0 to {MAX_DEGREE}, found {self.sh_degree}")
        if not 0 < self.resolution <= 1:
            raise ValueError(f"reconstruct: expected resolution in (0, 1], found {self.resolution}")
        if self.eval_every == 1:
            raise ValueError(
                "reconstruct: expected eval_every of 0 or at least 2, found 1, which leaves no view to fit"
            )
