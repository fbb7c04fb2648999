"""Consolidation: fits the SH colours of a composite to independently harmonised views; geometry and opacity stay.

The paper (section Multi-View Consolidation) descends on LPIPS. Here, a short descent refines a least-squares fit:

1. Find the pixels that the harmoniser changed and the Gaussians on them; the others stay.
2. Solve normal equations for the colours, with each view's tint and flow (`normal_equations`, `view_errors`).
3. Descend for a few passes on windowed Fourier magnitudes, which keep texture where views disagree.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views
from splatgraft.consolidation.normal_equations import solve
from splatgraft.consolidation.options import ConsolidateOptions, ImageSequence
from splatgraft.consolidation.view_errors import CorrectedTargets
from splatgraft.core.cameras import Cameras, Window
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting import adam
from splatgraft.fitting.perceptual_losses import ImageLoss
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent

# set by hand
_CHANGED_SHARE = 0.02  # share of a Gaussian's blending weight on changed pixels above which it is active
_VISIBLE_SHARE = 1.0 / 255  # active Gaussians' share of a pixel above which it lies in the window: one grey level
_MARGIN_PX = 16  # border of the windows, so that windowed losses see the surroundings
_SAVE_EVERY = 500  # iterations of a descent between two checkpoints


@dataclass(frozen=True)
class Rates:
    """Learning rates of Adam on the colours."""

    first: float
    """Step size of band 0."""
    rest_ratio: float
    """Step size of the higher bands over that of band 0."""
    final_ratio: float
    """Last step size over the first, approached along a cosine."""


_POLISH = Rates(first=0.03, rest_ratio=0.1, final_ratio=0.02)


def consolidate(
    composite: Gaussians,
    cameras: Cameras,
    images: ImageSequence,
    options: ConsolidateOptions = ConsolidateOptions(),
    *,
    progress: Progress = silent,
) -> Gaussians:
    """Fit the colours of a scene (all SH bands) to harmonised images of it; geometry and opacity stay.

    Paper: section Multi-View Consolidation. Higher bands start from zero. Gaussians that no changed pixel sees keep
    their colours exactly. Equal inputs and seeds give equal results.

    For n Gaussians with k coefficients, the memory above the inputs is 4 n (k^2 + 50 k) bytes, the tile lists of two
    views and a few images. Views and their corrected images add up to `options.cache_bytes`. The memory does not grow
    further with the number of views.

    Args:
        composite: The scene of which the images were made.
        cameras: v cameras, on the device of `composite`.
        images: v harmonised images (h, w, 3), sRGB in [0, 1], each of its camera's size, read one at a time.
        options: Loss, errors of views, and length of the descent.
        progress: Called with steps done, steps in all and a short text.

    Returns:
        The scene with the fitted colours.

    Raises:
        ValueError: There is no camera or not one image per camera, or an image has another size than its camera or
            numbers that are not finite.
    """
    check_counts(cameras, images)
    views = Views(composite, cameras, images, options=options)
    views = restrict_to_changes(views, options.unchanged_below)
    if len(views) == 0:
        return composite
    active = slice(None) if views.active is None else views.active
    targets = CorrectedTargets(views, options.view_error)
    prior = drop_higher_bands(composite.sh)[active]
    sh = solve(prior, targets, progress=progress)
    targets.keep()
    if options.polish_passes:
        descent = Descent(_POLISH, options.polish_passes * len(views), options.loss, options.seed)
        sh = optimize_colors(sh, targets, descent, progress)
    colors = composite.sh.clone()
    colors[active] = sh
    return replace(composite, sh=colors)


def check_counts(cameras: Cameras, images: ImageSequence) -> None:
    """Raise ValueError unless there are views, with one image each."""
    if len(cameras) == 0:
        raise ValueError("consolidate: expected at least one view, found none")
    if len(images) != len(cameras):
        raise ValueError(f"consolidate: expected one image per camera, found {len(images)} for {len(cameras)}")


@torch.no_grad()
def restrict_to_changes(views: Views, unchanged_below: float) -> Views:
    """Crop the views to the changed pixels, and fix the Gaussians that no changed pixel sees.

    A pixel is changed if it differs by `unchanged_below` or more, in sRGB, from the composite's render; 0 or less gives
    `views` themselves.
    """
    if unchanged_below <= 0:
        return views
    active = _on_changed_pixels(views, unchanged_below)
    if bool(active.all()):
        return views
    return views.restricted(active, [_window(views, index, active) for index in range(len(views))])


def _on_changed_pixels(views: Views, unchanged_below: float) -> Bool[Tensor, "n"]:
    weights = torch.zeros(views.composite.count, 2, device=views.composite.device)
    for index in range(len(views)):
        view = views[index]
        picture = view.render(views.composite.sh).clamp(0, 1)
        changed = ((views.target(index) - picture).abs().amax(-1) >= unchanged_below).to(picture.dtype)
        weights += view.blend_transpose(torch.stack([changed, torch.ones_like(changed)], -1))
    return (weights[:, 0] > _CHANGED_SHARE * weights[:, 1]) & (weights[:, 1] > 0)


def _window(views: Views, index: int, active: Bool[Tensor, "n"]) -> Window | None:
    share: Float[Tensor, "h w"] = views[index].blend(active[:, None].to(views.composite.sh.dtype))[..., 0]
    rows, columns = torch.nonzero(share >= _VISIBLE_SHARE, as_tuple=True)
    if len(rows) == 0:
        return None
    height, width = share.shape
    return (
        max(0, int(columns.min()) - _MARGIN_PX),
        max(0, int(rows.min()) - _MARGIN_PX),
        min(width, int(columns.max()) + 1 + _MARGIN_PX),
        min(height, int(rows.max()) + 1 + _MARGIN_PX),
    )


def drop_higher_bands(sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k 3"]:
    """Set the bands above 0 to zero (paper, section Multi-View Consolidation)."""
    return torch.cat([sh[:, :1], torch.zeros_like(sh[:, 1:])], 1)


@dataclass(frozen=True)
class Descent:
    """Settings of a gradient descent on the colours."""

    rates: Rates
    iterations: int
    """Number of steps, one view each."""
    loss: ImageLoss
    seed: int
    """Seed of the order of views."""
    checkpoint: Checkpoint = field(default_factory=NoCheckpoint)
    """Storage of the state, which is saved every 500 iterations."""


def optimize_colors(
    sh: Float[Tensor, "m k 3"], targets: CorrectedTargets, descent: Descent, progress: Progress
) -> Float[Tensor, "m k 3"]:
    """Descend on the colours by Adam over views in shuffled order; a step changes only visible Gaussians."""
    views, start, iterations, checkpoint = targets.views, 0, descent.iterations, descent.checkpoint
    sh = sh.clone().contiguous()
    moments = adam.no_moments({"sh": sh}, len(sh))
    saved = checkpoint.load()
    if saved is not None:
        start, sh = int(saved["iteration"]), saved["sh"].clone()
        moments = adam.Moments({"sh": saved["first"].clone()}, {"sh": saved["second"].clone()}, saved["steps"].clone())
    shares = torch.full((3 * sh.shape[1],), descent.rates.rest_ratio, device=sh.device)
    shares[:3] = 1.0
    for iteration in range(start, iterations):
        index = _view_of(iteration, len(views), descent.seed)
        view = views[index]
        colors = view.colors(sh).requires_grad_()
        value = descent.loss(view.draw(colors), targets.target(index))
        rates = descent.rates.first * _decay(iteration / iterations, descent.rates.final_ratio) * shares
        if not view.expansion.descend(sh, torch.autograd.grad(value, colors)[0], moments=moments, rates=rates):
            name = views.cameras.names[index]
            raise ValueError(f"consolidate: expected finite gradients, found others in {name} at iteration {iteration}")
        if (iteration + 1) % _SAVE_EVERY == 0:
            state = {"first": moments.first["sh"], "second": moments.second["sh"], "steps": moments.steps}
            checkpoint.save({"iteration": iteration + 1, "sh": sh, **state})
        progress(iteration + 1, iterations, f"loss {float(value.detach()):.4f}")
    return sh


def _view_of(iteration: int, count: int, seed: int) -> int:
    """Choose the view of an iteration: each pass visits all views, in an order that depends on seed and pass only."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed * 1_000_003 + iteration // count))
    return int(order[iteration % count])


def _decay(done: float, final_ratio: float) -> float:
    """Compute the factor on the learning rate after the share `done` of all steps: a cosine from 1 to `final_ratio`."""
    return final_ratio + (1 - final_ratio) * 0.5 * (1 + math.cos(math.pi * done))
