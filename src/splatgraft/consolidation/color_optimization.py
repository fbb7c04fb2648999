"""Optimises SH colours with Adam under an image loss, one view per iteration; geometry and opacity are frozen.

The paper's method (section Multi-View Consolidation), and the last part of the method `fast`.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation.corrected_targets import CorrectedTargets
from splatgraft.consolidation.options import DescentOptions
from splatgraft.fitting import adam
from splatgraft.fitting.perceptual_losses import ImageLoss
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent


def optimize_colors(  # noqa: PLR0913 - with progress and checkpoint
    sh: Float[Tensor, "m k 3"],
    targets: CorrectedTargets,
    options: DescentOptions,
    *,
    loss: ImageLoss,
    seed: int = 0,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Float[Tensor, "m k 3"]:
    """Colours after `options.iterations` steps of Adam over views in shuffled order; only visible Gaussians change.

    Args:
        sh: Initial coefficients of the active Gaussians.
        targets: Views and their corrected images.
        options: Rates and number of iterations.
        loss: Distance from the render to the target.
        seed: Of the order of views.
        progress: Called after each iteration.
        checkpoint: Where the state is saved every `options.save_every` iterations.

    Raises:
        ValueError: Where a gradient is not finite, which a loss that divides can cause.
    """
    views, start = targets.views, 0
    sh = sh.clone().contiguous()
    moments = adam.no_moments({"sh": sh}, len(sh))
    saved = checkpoint.load()
    if saved is not None:
        start, sh = int(saved["iteration"]), saved["sh"].clone()
        moments = adam.Moments({"sh": saved["first"].clone()}, {"sh": saved["second"].clone()}, saved["steps"].clone())
    shares = torch.full((3 * sh.shape[1],), options.rest_ratio, device=sh.device)
    shares[:3] = 1.0
    for iteration in range(start, options.iterations):
        index = _view_of(iteration, len(views), seed)
        view = views[index]
        colors = view.colors(sh).requires_grad_()
        picture = view.draw(colors)
        picture, target = _weighted_pair(picture, targets.target(index), views.weight(index))
        value = loss(picture, target)
        rates = options.rate * _decay(iteration / options.iterations, options.final_ratio) * shares
        if not view.expansion.descend(sh, torch.autograd.grad(value, colors)[0], moments=moments, rates=rates):
            name = views.cameras.names[index]
            raise ValueError(f"consolidate: expected finite gradients, found others in {name} at iteration {iteration}")
        if (iteration + 1) % options.save_every == 0:
            checkpoint.save(
                {
                    "iteration": iteration + 1,
                    "sh": sh,
                    "first": moments.first["sh"],
                    "second": moments.second["sh"],
                    "steps": moments.steps,
                }
            )
        progress(iteration + 1, options.iterations, f"loss {float(value.detach()):.4f}")
    return sh


def _view_of(iteration: int, count: int, seed: int) -> int:
    """The view of an iteration: each pass visits all views in an order that depends on seed and pass only."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed * 1_000_003 + iteration // count))
    return int(order[iteration % count])


def _decay(done: float, final_ratio: float) -> float:
    """Factor on the learning rate after the share `done` of all iterations: half a cosine from 1 to `final_ratio`."""
    return final_ratio + (1 - final_ratio) * 0.5 * (1 + math.cos(math.pi * done))


def _weighted_pair(
    picture: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], weight: Float[Tensor, "h w"] | None
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    """Both images blended by confidence with the detached render, so that any loss ignores pixels of weight 0."""
    if weight is None:
        return picture, target
    share, constant = weight[..., None], picture.detach()
    return share * picture + (1 - share) * constant, share * target + (1 - share) * constant
