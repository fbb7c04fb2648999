"""The paper's consolidation (section Multi-View Consolidation) and its iterative updates of the views (ablations).

The consolidation takes 10,000 steps of Adam on LPIPS, from the composite's band 0. In an update the views are
harmonised again, from renders of the scene so far, with less noise than before.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation import ConsolidateOptions, ImageSequence
from splatgraft.consolidation.color_fit import Descent, Rates, check_counts, drop_higher_bands, optimize_colors
from splatgraft.consolidation.frozen_views import Views
from splatgraft.consolidation.view_errors import CorrectedTargets
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting.perceptual_losses import ImageLoss
from splatgraft.harmonization import HarmonizerInputs
from splatgraft.rendering import RenderOptions
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent

Schedule = Literal["linear", "geometric"]
_RATES = Rates(first=0.0025, rest_ratio=0.05, final_ratio=1.0)  # 3DGS's feature_lr and its 1/20, constant


@dataclass(frozen=True)
class PaperDescent:
    """Settings of the paper's consolidation (its Sec. 6)."""

    loss: ImageLoss
    """Loss of the descent; the paper's is LPIPS alone."""
    iterations: int = 10_000
    """Number of steps, one view each."""
    continued: bool = False
    """Whether the descent goes on from all bands of a scene that was consolidated before, instead of band 0 alone."""
    rendering: RenderOptions = field(default_factory=RenderOptions)
    """Options of the renderer."""
    seed: int = 0
    """Seed of the order of the views."""


def descend_as_paper(
    composite: Gaussians,
    cameras: Cameras,
    images: ImageSequence,
    settings: PaperDescent,
    *,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit colours to harmonised images by the paper's gradient descent; geometry and opacity stay.

    The inputs are those of `splatgraft.consolidate`. For n Gaussians with k coefficients, memory above the inputs is
    4 n 24 k bytes, the tile lists of two views and a few images. Cached views add up to 3 GiB.

    Raises:
        ValueError: There is no camera or not one image per camera, or an image has another size than its camera or
            numbers that are not finite.
    """
    check_counts(cameras, images)
    options = ConsolidateOptions(rendering=settings.rendering)
    targets = CorrectedTargets(Views(composite, cameras, images, options=options), estimated=False)
    descent = Descent(_RATES, settings.iterations, settings.loss, settings.seed, checkpoint)
    begin = composite.sh if settings.continued else drop_higher_bands(composite.sh)
    return replace(composite, sh=optimize_colors(begin, targets, descent, progress))


def noise_levels(schedule: Schedule, updates: int) -> tuple[float, ...]:
    """Compute the noise from which each harmonisation starts: from 1 to 0.1 by equal differences or equal ratios.

    Paper: section Ablations, Iterative Dataset Update. The first harmonisation starts from noise alone.
    """
    steps = [number / max(updates - 1, 1) for number in range(updates)]
    return tuple(1 - 0.9 * step if schedule == "linear" else 0.1**step for step in steps)


@runtime_checkable
class NoisyStartHarmonizer(Protocol):
    """A harmoniser that can start from a partly noisy image, for iterative updates (paper, ablations)."""

    def harmonize_from(self, view: HarmonizerInputs, strength: float) -> Float[Tensor, "h w 3"]:
        """Harmonise `view`, conditioned on its composite, starting from its prior at a noise level in (0, 1]."""
        ...
