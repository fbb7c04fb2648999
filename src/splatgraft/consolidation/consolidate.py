"""Consolidation: fits the SH colours of a composite to independently harmonised views; geometry and opacity stay.

Two methods: the paper's gradient descent (section Multi-View Consolidation), and least squares by normal equations,
followed by a short descent.
"""

from dataclasses import replace

from splatgraft.consolidation.changed_region import drop_higher_bands, restrict_to_changes
from splatgraft.consolidation.color_optimization import optimize_colors
from splatgraft.consolidation.corrected_targets import CorrectedTargets
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
    `adam`, plus up to `options.cache_bytes` (views, then their corrected images, are kept until it is full), the tile
    lists of two views and a few images; beyond that it does not grow with the number of views.

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
        options=options,
    )
    if options.method == "adam":
        sh = optimize_colors(
            drop_higher_bands(composite.sh),
            CorrectedTargets(views, None),
            options.reference,
            loss=options.loss,
            seed=options.seed,
            progress=progress,
            checkpoint=checkpoint,
        )
        return replace(composite, sh=sh)
    return _consolidate_fast(composite, restrict_to_changes(views, options.unchanged_below), options, progress)


def _consolidate_fast(composite: Gaussians, views: Views, options: ConsolidateOptions, progress: Progress) -> Gaussians:
    if len(views) == 0:
        return composite
    active = slice(None) if views.active is None else views.active
    targets = CorrectedTargets(views, options.view_error)
    prior = drop_higher_bands(composite.sh)[active]
    sh = solve(prior, targets, options.solve, progress=progress)
    targets.keep()
    if options.polish_passes:
        polish = replace(options.polish, iterations=options.polish_passes * len(views))
        sh = optimize_colors(sh, targets, polish, loss=options.loss, seed=options.seed, progress=progress)
    colors = composite.sh.clone()
    colors[active] = sh
    return replace(composite, sh=colors)


def _check_counts(cameras: Cameras, images: ImageSequence, weights: ImageSequence | None) -> None:
    if len(cameras) == 0:
        raise ValueError("consolidate: expected at least one view, found none")
    for kind, sequence in (("image", images), ("weight", weights)):
        if sequence is not None and len(sequence) != len(cameras):
            raise ValueError(f"consolidate: expected one {kind} per camera, found {len(sequence)} for {len(cameras)}")
