"""Options of a consolidation: method, least squares, gradient descent, and what is cached."""

from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

from torch import Tensor

from splatgraft.fitting.perceptual_losses import ImageLoss, windowed_fourier
from splatgraft.rendering import RenderOptions


@runtime_checkable
class ImageSequence(Protocol):
    """Images by index, read on access; a list of tensors is one."""

    def __len__(self) -> int:
        """Number of images."""
        ...

    def __getitem__(self, index: int, /) -> Tensor:
        """The image of that view."""
        ...


@dataclass(frozen=True)
class SolveOptions:
    """The linear part of `fast`: colours by conjugate gradient on the normal equations."""

    rounds: int = 3
    """Times that targets are corrected and the equations solved, each from the last solution; at least 2."""
    steps: int = 6
    """Steps of conjugate gradient per round; each blends every view once and applies the transpose once."""
    prior_px: float = 0.1
    """Ridge towards the composite's colour, pixels: it decides only Gaussians that no view sees."""
    band_ridges: tuple[float, ...] = (0.003, 0.02, 0.1)
    """Ridges of the higher bands to choose from, as shares of the pixels that the Gaussian makes up.

    Which one predicts held-out views best depends on how much the views disagree. Below ten views: the largest."""


@dataclass(frozen=True)
class DescentOptions:
    """Adam on the colours under an image loss."""

    iterations: int = 10_000
    """Steps, one view each."""
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
    """How colours are fitted to harmonised views."""

    method: Literal["fast", "adam"] = "fast"
    """`adam`: the paper's descent (`reference`). `fast`: normal equations, then a short descent (`polish`)."""
    loss: ImageLoss = windowed_fourier
    """Loss of the descent."""
    view_error: bool = True
    """Whether a tint and a flow per view are estimated beside the colours; `fast` only."""
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
    min_row_weight: float = 1e-4
    """Weights of a Gaussian in 16 pixels of a row that add up to no more are left out at its ends; 0: none are.

    As the renderer's least transmittance; at most a fortieth of a grey level in a pixel. It saves half the work."""
    cache_bytes: int = 3 * 2**30
    """Bytes of tile lists and bases cached between passes; the rest is computed again in each pass."""
    rendering: RenderOptions = field(default_factory=RenderOptions)
    """How the scene is rendered."""
    seed: int = 0
    """Seed of the order of the views."""
