"""Options of a consolidation."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from splatgraft.fitting.perceptual_losses import ImageLoss, lpips_vgg, windowed_fourier
from splatgraft.rendering import RenderOptions

ImageSequence = Sequence[Tensor]
"""Images by index, which may be read on access."""


@dataclass(frozen=True)
class ConsolidateOptions:
    """How colours are fitted to harmonised views."""

    method: Literal["fast", "paper"] = "fast"
    """`paper`: steps of Adam from the composite's band 0. `fast`: normal equations, then a short descent."""
    loss: ImageLoss | None = None
    """Loss of the descent; None: windowed Fourier magnitudes for `fast`, LPIPS alone for `paper` (its Sec. 6)."""
    view_error: bool = True
    """Whether a tint and a flow per view are estimated beside the colours; `fast` only."""
    polish_passes: int = 12
    """Descent of `fast` after the equations: passes over all views."""
    iterations: int = 10_000
    """Steps of `paper`, one view each."""
    continued: bool = False
    """Whether `paper` goes on from all bands of the scene, which was consolidated before, instead of band 0 alone."""
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

    @property
    def image_loss(self) -> ImageLoss:
        """The loss, given or of the method.

        Raises: ValueError where LPIPS's weights are not in torch hub's cache.
        """
        return self.loss or (lpips_vgg() if self.method == "paper" else windowed_fourier)
