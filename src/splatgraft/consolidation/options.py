"""Options of a consolidation."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from splatgraft.fitting.perceptual_losses import ImageLoss, windowed_fourier
from splatgraft.rendering import RenderOptions

ImageSequence = Sequence[Tensor]
"""Images by index, which may be read on access."""


@dataclass(frozen=True)
class ConsolidateOptions:
    """Options of the fit of colours to harmonised views."""

    loss: ImageLoss = windowed_fourier
    """Loss of the descent: windowed Fourier magnitudes."""
    view_error: bool = True
    """Whether a tint and a flow per view are estimated beside the colours."""
    polish_passes: int = 12
    """Descent after the equations: passes over all views."""
    unchanged_below: float = 2.0 / 255
    """sRGB difference from the composite's render below which a pixel is unchanged; with 0 all pixels are changed."""
    min_row_weight: float = 1e-4
    """Bound on the sum of a Gaussian's weights in a row of 16 pixels; its first and last rows below it are dropped.

    It equals the renderer's least transmittance, changes a pixel by at most a fortieth of a grey level, and saves half
    of the work. 0 drops nothing."""
    cache_bytes: int = 3 * 2**30
    """Bytes of tile lists and bases that are kept between passes; others are computed again in each pass."""
    rendering: RenderOptions = field(default_factory=RenderOptions)
    """Options of the renderer."""
    seed: int = 0
    """Seed of the order of the views."""
