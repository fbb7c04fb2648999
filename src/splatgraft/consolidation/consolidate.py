"""Consolidation: independently harmonised views become one scene again, by colours alone. Knows no paths."""

from dataclasses import replace

from splatgraft.consolidation.changed_region import narrow, reset_bands
from splatgraft.consolidation.corrected_targets import Corrections
from splatgraft.consolidation.descent import descend
from splatgraft.consolidation.frozen_views import Views
from splatgraft.consolidation.normal_equations import solve
from splatgraft.consolidation.options import ConsolidateOptions, ImageSequence
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent


def consolidate(  # noqa: PLR0913 - three inputs, options, and the two services of every long stage
    composite: Gaussians,
    cameras: Cameras,
    images: ImageSequence,
    options: ConsolidateOptions = ConsolidateOptions(),
    *,
    weights: ImageSequence | None = None,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit the colours of a scene (all SH bands) to harmonised images of it; geometry and opacity stay.

    Paper: section Multi-View Consolidation. Higher bands start from zero. With the method `fast`, Gaussians that no
    changed pixel sees keep their colours exactly. The same inputs and seed give the same result.

    Memory above the inputs, for n Gaussians with k coefficients: 4 n (k^2 + 50 k) bytes for `fast`, 4 n 24 k for
    `adam`, plus `options.cache_bytes`, the tile lists of two views and a few images; it does not grow with the number
    of views.

    Args:
        composite: The scene of which the images were made.
        cameras: v cameras, on the device of `composite`.
        images: v harmonised images (h, w, 3), sRGB in [0, 1], each of its camera's size, read one at a time.
        options: Method, loss, nuisance parameters and rates.
        weights: Confidence of every pixel, v images (h, w) in [0, 1]; 1 everywhere where not given.
        progress: Called with steps done, steps in all and a short text.
        checkpoint: Where `adam` saves its state and from where it continues.

    Returns:
        The scene with the fitted colours.

    Raises:
        ValueError: There is no camera or not one image per camera, or an image has another size than its camera or
            numbers that are not finite.
    """
    _check_counts(cameras, images, weights)
    views = Views(
        composite,
        cameras,
        images,
        weights=weights,
        rendering=options.rendering,
        cache_bytes=options.cache_bytes,
    )
    if options.method == "adam":
        sh = descend(
            reset_bands(composite.sh),
            Corrections(views, None),
            options.reference,
            loss=options.loss,
            seed=options.seed,
            progress=progress,
            checkpoint=checkpoint,
        )
        return replace(composite, sh=sh)
    return _fast(composite, narrow(views, options.unchanged_below), options, progress)


def _fast(composite: Gaussians, views: Views, options: ConsolidateOptions, progress: Progress) -> Gaussians:
    if len(views) == 0:
        return composite
    moving = slice(None) if views.moving is None else views.moving
    corrections = Corrections(views, options.nuisance)
    prior = reset_bands(composite.sh)[moving]
    sh = solve(prior, corrections, options.solve, progress=progress)
    if options.polish_passes:
        polish = replace(options.polish, iterations=options.polish_passes * len(views))
        sh = descend(sh, corrections, polish, loss=options.loss, seed=options.seed, progress=progress)
    colors = composite.sh.clone()
    colors[moving] = sh
    return replace(composite, sh=colors)


def _check_counts(cameras: Cameras, images: ImageSequence, weights: ImageSequence | None) -> None:
    if len(cameras) == 0:
        raise ValueError("consolidate: expected at least one view, found none")
    for kind, sequence in (("image", images), ("weight", weights)):
        if sequence is not None and len(sequence) != len(cameras):
            raise ValueError(f"consolidate: expected one {kind} per camera, found {len(sequence)} for {len(cameras)}")
