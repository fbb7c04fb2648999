"""The choices of a consolidation. Holds no arithmetic."""

from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

from torch import Tensor

from splatgraft.consolidation.view_errors import NuisanceOptions
from splatgraft.fitting.perceptual_losses import ImageLoss, windowed_fourier
from splatgraft.rendering import RenderOptions


@runtime_checkable
class ImageSequence(Protocol):
    """Images by index, read when asked for; a list of tensors is one."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __getitem__(self, index: int, /) -> Tensor:
        """The image of that view."""
        ...


@dataclass(frozen=True)
class SolveOptions:
    """The linear part of the fast road: colours by conjugate gradient on the normal equations."""

    rounds: int = 3
    """How often the images are corrected and the equations solved again, from the last solution; at least 2."""
    steps: int = 6
    """Steps of conjugate gradient per round; each blends and gathers every view once."""
    prior_px: float = 0.1
    """Weight of the composite's colour in every Gaussian, pixels: decides only what no view sees."""
    band_ridges: tuple[float, ...] = (0.003, 0.02, 0.1)
    """Weights of zero for the higher bands to choose from, as shares of the pixels that the Gaussian is seen in.

    What predicts views left out best depends on how much the views disagree. Fewer than ten views: the largest."""


@dataclass(frozen=True)
class DescentOptions:
    """Adam on the colours under an image loss, one view per iteration."""

    iterations: int = 10_000
    """One view each."""
    rate: float = 0.0025
    """Learning rate of band 0 (3DGS: feature_lr)."""
    rest_ratio: float = 0.05
    """Learning rate of the higher bands over that of band 0 (3DGS: 1/20)."""
    final_ratio: float = 1.0
    """Last learning rate over the first, approached along a cosine; 1 keeps it constant, as the paper does."""
    save_every: int = 500
    """Iterations between two checkpoints."""


@dataclass(frozen=True)
class ConsolidateOptions:
    """How harmonised views become one scene."""

    method: Literal["fast", "adam"] = "fast"
    """`adam`: the paper's reference, `reference` alone. `fast`: normal equations, then a short descent."""
    loss: ImageLoss = windowed_fourier
    """What the descent minimises."""
    nuisance: NuisanceOptions | None = field(default_factory=NuisanceOptions)
    """Solve a tint and a flow per view beside the colours; None: take every view at its word. `fast` only."""
    solve: SolveOptions = field(default_factory=SolveOptions)
    """The linear part of `fast`."""
    polish_passes: int = 12
    """Descent of `fast` after the equations: passes over all views."""
    polish: DescentOptions = field(default_factory=lambda: DescentOptions(rate=0.03, rest_ratio=0.1, final_ratio=0.02))
    """Rates of that descent; its number of iterations is `polish_passes` times the number of views."""
    reference: DescentOptions = field(default_factory=DescentOptions)
    """The descent of `adam`."""
    unchanged_below: float = 2.0 / 255
    """Pixels that differ less than this from the composite's render are unchanged; 0: all count as changed. `fast`."""
    cache_bytes: int = 256 * 2**20
    """Tile lists and bases kept between passes; what does not fit is computed again in each pass."""
    rendering: RenderOptions = field(default_factory=RenderOptions)
    """How the scene is drawn."""
    seed: int = 0
    """Order of the views."""
