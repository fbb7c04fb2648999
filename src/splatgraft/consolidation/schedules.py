"""Iterative dataset update: harmonise and consolidate in turn, with decreasing noise.

Paper: ablation Iterative Dataset Update (after Haque 2023, Instruct-NeRF2NeRF); five updates from 1.0 to 0.1.
"""

from collections.abc import Callable, Sequence

from splatgraft.consolidation.consolidate import consolidate
from splatgraft.consolidation.options import ConsolidateOptions, ImageSequence
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.runtime.progress import Progress, silent

HarmonizeAt = Callable[[Gaussians, float], ImageSequence]
"""From the current scene and a noise strength in (0, 1] to one harmonised image per camera."""


def linear_schedule(updates: int = 5, first: float = 1.0, last: float = 0.1) -> tuple[float, ...]:
    """Noise strengths from `first` to `last` with equal differences."""
    return tuple(first + (last - first) * _share(i, updates) for i in range(updates))


def geometric_schedule(updates: int = 5, first: float = 1.0, last: float = 0.1) -> tuple[float, ...]:
    """Noise strengths from `first` to `last` with equal ratios."""
    return tuple(first * (last / first) ** _share(i, updates) for i in range(updates))


def _share(index: int, count: int) -> float:
    return index / (count - 1) if count > 1 else 0.0


def iterative_update(
    composite: Gaussians,
    cameras: Cameras,
    harmonize_at: HarmonizeAt,
    strengths: Sequence[float],
    options: ConsolidateOptions = ConsolidateOptions(),
    *,
    progress: Progress = silent,
) -> Gaussians:
    """The scene after one consolidation per strength, each on images harmonised from renders of the one before.

    Args:
        composite: The start of each consolidation.
        cameras: Of the views.
        harmonize_at: Conditions on the composite and adds noise to renders of the scene that it is given, which the
            paper found sharper.
        strengths: Noise strengths in (0, 1], one per update.
        options: Of each consolidation.
        progress: Of each consolidation.

    Raises:
        ValueError: Where a strength is outside (0, 1].
    """
    if any(not 0 < strength <= 1 for strength in strengths):
        raise ValueError(f"iterative update: expected strengths in (0, 1], found {tuple(strengths)}")
    scene = composite
    for strength in strengths:
        scene = consolidate(composite, cameras, harmonize_at(scene, strength), options, progress=progress)
    return scene
