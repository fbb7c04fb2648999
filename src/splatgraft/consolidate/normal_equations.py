"""Least squares for SH colours by block-preconditioned conjugate gradient on the views' fixed maps.

With geometry frozen a pixel is a fixed weighted sum of colours, and a colour a fixed weighted sum of SH coefficients:
sum_v |W_v B_v x - image_v|^2 + ridge |x - prior|^2 is quadratic (after "Instant Colorization of Gaussian Splats",
2026). Renderers clamp colours at zero; the equations do not, and leave that to the descent. Knows nothing about losses.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidate.corrections import Corrections
from splatgraft.consolidate.options import SolveOptions
from splatgraft.consolidate.views import Views
from splatgraft.progress import Progress, silent


@dataclass(frozen=True)
class _Equations:
    """What stays fixed while the images are corrected."""

    ridge: Float[Tensor, "m k"]
    """Weight of the prior, pixels."""
    factor: Float[Tensor, "m k k"]
    """Cholesky factors of the preconditioner: each Gaussian alone, with the others moving along."""


@torch.no_grad()
def solve(
    prior: Float[Tensor, "m k 3"],
    corrections: Corrections,
    options: SolveOptions,
    *,
    progress: Progress = silent,
) -> Float[Tensor, "m k 3"]:
    """The colours that explain all views best, from and towards `prior`."""
    views = corrections.views
    total = options.rounds * (options.steps + 1) + 1
    progress(0, total, "setting up the equations")
    equations = _set_up(prior, views, options)
    sh = prior.clone()
    for turn in range(options.rounds):
        done = 1 + turn * (options.steps + 1)
        residual, error = _residual(sh, corrections, refine=turn > 0)
        progress(done, total, f"rmse {error:.4f}")
        residual -= equations.ridge[..., None] * (sh - prior)
        sh += _conjugate_gradient(
            residual, views, equations, options.steps, progress=lambda step, done=done: progress(done + step, total, "")
        )
    return sh


def _set_up(prior: Float[Tensor, "m k 3"], views: Views, options: SolveOptions) -> _Equations:
    """Blocks sum_v (W^T W 1) b b^T: W is non-negative, so these row sums bound what neighbours add to a Gaussian."""
    m, k = prior.shape[:2]
    blocks, seen = prior.new_zeros(m, k, k), prior.new_zeros(m, 1)
    for index in range(len(views)):
        view, weight = views[index], views.weight(index)
        share = view.blend(prior.new_ones(m, 1))
        share = view.gather(share if weight is None else share * weight[..., None])
        blocks.baddbmm_((share * view.basis)[:, :, None], view.basis[:, None, :])
        seen += share
    degree = torch.arange(k, device=prior.device).sqrt().floor().long()
    relative = prior.new_tensor((0.0, *options.band_ridge))[degree]
    ridge = seen * relative + options.prior_px
    blocks.diagonal(dim1=1, dim2=2).add_(ridge)
    return _Equations(ridge=ridge, factor=torch.linalg.cholesky(blocks))


def _residual(
    sh: Float[Tensor, "m k 3"], corrections: Corrections, *, refine: bool
) -> tuple[Float[Tensor, "m k 3"], float]:
    """What the equations still ask for, and the root mean square error over all pixels."""
    views, out, squares, count = corrections.views, torch.zeros_like(sh), 0.0, 0
    for index in range(len(views)):
        view = views[index]
        picture = view.render(sh)
        if refine:
            corrections.refine(index, picture)
        difference = corrections.target(index) - picture
        weight = views.weight(index)
        if weight is not None:
            difference = difference * weight[..., None]
        out += view.basis[:, :, None] * view.gather(difference)[:, None, :]
        squares += float((difference**2).sum())
        count += difference.numel()
    return out, (squares / max(count, 1)) ** 0.5


def _conjugate_gradient(
    residual: Float[Tensor, "m k 3"],
    views: Views,
    equations: _Equations,
    steps: int,
    *,
    progress: Callable[[int], None],
) -> Float[Tensor, "m k 3"]:
    """`steps` steps on the correction, each colour channel by itself; the products are summed in double precision."""
    solution = torch.zeros_like(residual)
    conditioned = torch.cholesky_solve(residual, equations.factor)
    direction, before = conditioned, _dot(residual, conditioned)
    for step in range(steps):
        image_of = _apply(direction, views, equations)
        length = before / _dot(direction, image_of).clamp_min(1e-30)
        solution += length * direction
        residual = residual - length * image_of
        conditioned = torch.cholesky_solve(residual, equations.factor)
        now = _dot(residual, conditioned)
        direction = conditioned + (now / before.clamp_min(1e-30)) * direction
        before = now
        progress(step + 1)
    return solution


def _apply(sh: Float[Tensor, "m k 3"], views: Views, equations: _Equations) -> Float[Tensor, "m k 3"]:
    out = equations.ridge[..., None] * sh
    for index in range(len(views)):
        view, weight = views[index], views.weight(index)
        picture = view.blend(torch.einsum("mk,mkc->mc", view.basis, sh))
        if weight is not None:
            picture = picture * weight[..., None]
        out += view.basis[:, :, None] * view.gather(picture)[:, None, :]
    return out


def _dot(a: Float[Tensor, "m k 3"], b: Float[Tensor, "m k 3"]) -> Float[Tensor, "3"]:
    return (a.double() * b.double()).sum((0, 1)).to(a.dtype)
