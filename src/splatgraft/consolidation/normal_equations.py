"""Solves least squares for SH colours by block-preconditioned conjugate gradient on the views' fixed maps.

With frozen geometry a pixel is a fixed weighted sum of colours, and a colour is a fixed weighted sum of SH
coefficients. So sum_v |W_v B_v x - image_v|^2 + ridge |x - prior|^2 is quadratic in the coefficients x (after "Instant
Colorization of Gaussian Splats", 2026). Renderers clamp colours at zero. The equations do not; the descent that follows
does.

Targets are corrected for errors of the views between rounds, and the ridge of the higher bands is chosen by
cross-validation over views.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views
from splatgraft.consolidation.view_errors import CorrectedTargets
from splatgraft.runtime.progress import Progress, silent

_ROUNDS = 3  # corrections of the targets, each with a solution that starts from the last one
_STEPS = 6  # steps of conjugate gradient per round; each blends every view and applies the transpose once
_PRIOR_PX = 0.1  # ridge towards the composite's colour, pixels: it decides only Gaussians that no view sees
_BAND_RIDGES = (0.003, 0.02, 0.1)
"""Ridges of the higher bands to choose from, as shares of the pixels that the Gaussian makes up. The best
one for held-out views depends on the disagreement of the views. Below ten views the largest is taken."""
_FACTORED_AT_ONCE = 2**14  # gaussians per batch of Cholesky factorisations, which bounds the memory
_SUMMED_AT_ONCE = 2**12  # gaussians per batch of a dot product
_COMPARED_VIEWS = 40  # largest number of views on which ridges are compared
_HOLD_OUT_EVERY = 5  # one view in five is left out in the comparison of ridges


@dataclass(frozen=True)
class _Equations:
    """The quadratic form over some of the views, without the images."""

    views: Views
    """All views."""
    which: Sequence[int]
    """Indices of the views that count."""
    seen: Float[Tensor, "m 1"]
    """Pixels that each Gaussian makes up, summed over all views (row sums of W^T W)."""
    inverse: Float[Tensor, "m k k"]
    """The preconditioner: per Gaussian the inverse of a block with the row sums of W^T W on its diagonal."""
    ridge: Float[Tensor, "m k"]
    """Weight of the prior, pixels."""

    def with_ridge(self, band_ridge: float) -> "_Equations":
        """Replace the ridge of the higher bands."""
        return replace(self, ridge=_ridge(self.seen, self.ridge.shape[1], band_ridge))

    def apply(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "m k 3"]:
        """Multiply the matrix by coefficients."""
        out = self.ridge[..., None] * sh
        for index in self.which:
            view = self.views[index]
            colors = view.blend_and_transpose(view.expansion.colors(sh))
            view.expansion.add_transpose(colors, out)
        return out


@torch.no_grad()
def solve(
    prior: Float[Tensor, "m k 3"], targets: CorrectedTargets, *, progress: Progress = silent
) -> Float[Tensor, "m k 3"]:
    """Find the colours of least squared error over all views, with a ridge towards `prior`; refines the targets."""
    trials = len(_BAND_RIDGES) if len(targets.views) >= 2 * _HOLD_OUT_EVERY else 0
    total = _ROUNDS + trials + 1
    progress(0, total, "setting up the equations")
    # the strongest ridge first: then colours hardly depend on the view, and cannot fit a view's error as a highlight
    equations = _build_equations(prior, targets.views, max(_BAND_RIDGES))
    sh, error = prior, 0.0
    for turn in range(_ROUNDS):
        residual, error = _residual(sh, targets, equations.which, refine=turn > 0)
        targets.center()
        if turn == 1 and trials > 1:
            equations = equations.with_ridge(_select_ridge(prior, targets, equations))
        residual -= equations.ridge[..., None] * (sh - prior)
        sh = sh + _conjugate_gradient(residual, equations)
        progress(turn + 1 + (trials if turn else 0), total, f"rmse {error:.4f}")
    progress(total, total, f"rmse {error:.4f}")
    return sh


def _select_ridge(prior: Float[Tensor, "m k 3"], targets: CorrectedTargets, equations: _Equations) -> float:
    """Choose the ridge whose short solution without every 5th view predicts those views best (cross-validation).

    If there are many views, evenly spaced ones are enough, because the ridge is one number.
    """
    count = len(targets.views)
    compared = min(count, _COMPARED_VIEWS)
    chosen = [place * count // compared for place in range(compared)]
    held_out = chosen[_HOLD_OUT_EVERY // 2 :: _HOLD_OUT_EVERY]
    fitted = [index for index in chosen if index not in held_out]
    equations = replace(equations, seen=equations.seen * (compared / count))
    residual, _ = _residual(prior, targets, fitted, refine=False)
    errors = {}
    for band_ridge in _BAND_RIDGES:
        trial = replace(equations, which=fitted).with_ridge(band_ridge)
        sh = prior + _conjugate_gradient(residual, trial)
        errors[band_ridge] = _error(sh, targets, held_out)
    return min(errors, key=errors.__getitem__)


def _build_equations(prior: Float[Tensor, "m k 3"], views: Views, band_ridge: float) -> _Equations:
    """Build the blocks sum_v (W^T W 1) b b^T; W is non-negative, so that these row sums bound the neighbours' part."""
    m, k = prior.shape[:2]
    blocks, seen = prior.new_zeros(m, k, k), prior.new_zeros(m, 1)
    for index in range(len(views)):
        view = views[index]
        share = view.blend_transpose(view.blend(prior.new_ones(m, 1)))
        view.expansion.add_squares(share, blocks)
        seen += share
    ridge = _ridge(seen, k, band_ridge)
    blocks.diagonal(dim1=1, dim2=2).add_(ridge)
    for part in blocks.split(_FACTORED_AT_ONCE):  # in place: the blocks are the largest thing in memory
        part.copy_(torch.cholesky_inverse(torch.linalg.cholesky(part)))
    return _Equations(views, range(len(views)), seen, inverse=blocks, ridge=ridge)


def _ridge(seen: Float[Tensor, "m 1"], k: int, band_ridge: float) -> Float[Tensor, "m k"]:
    higher = (seen * band_ridge + _PRIOR_PX).expand(-1, k - 1)
    return torch.cat([torch.full_like(seen, _PRIOR_PX), higher], 1)


def _residual(
    sh: Float[Tensor, "m k 3"], targets: CorrectedTargets, which: Sequence[int], *, refine: bool
) -> tuple[Float[Tensor, "m k 3"], float]:
    """Compute the residual of the equations' right-hand side at `sh`, and the RMSE over the views' pixels."""
    views, out, squares, count = targets.views, torch.zeros_like(sh), 0.0, 0
    for index in which:
        view = views[index]
        picture = view.render(sh)
        if refine:
            targets.refine(index, picture)
        difference = targets.target(index) - picture
        view.expansion.add_transpose(view.blend_transpose(difference), out)
        squares += float((difference**2).sum())
        count += difference.numel()
    return out, (squares / count) ** 0.5


def _error(sh: Float[Tensor, "m k 3"], targets: CorrectedTargets, which: Sequence[int]) -> float:
    views = targets.views
    return sum(float((targets.target(i) - views[i].render(sh)).square().mean()) for i in which)


def _conjugate_gradient(residual: Float[Tensor, "m k 3"], equations: _Equations) -> Float[Tensor, "m k 3"]:
    """Solve for the correction, each colour channel by itself; the products are summed in double precision."""
    solution = torch.zeros_like(residual)
    conditioned = torch.bmm(equations.inverse, residual)
    direction, before = conditioned, _dot(residual, conditioned)
    for _ in range(_STEPS):
        image_of = equations.apply(direction)
        length = before / _dot(direction, image_of).clamp_min(1e-30)
        solution += length * direction
        residual = residual - length * image_of
        conditioned = torch.bmm(equations.inverse, residual)
        now = _dot(residual, conditioned)
        direction = conditioned + (now / before.clamp_min(1e-30)) * direction
        before = now
    return solution


def _dot(a: Float[Tensor, "m k 3"], b: Float[Tensor, "m k 3"]) -> Float[Tensor, "3"]:
    # in parts that stay in the processor's cache
    parts = zip(a.split(_SUMMED_AT_ONCE), b.split(_SUMMED_AT_ONCE), strict=True)
    total = sum((x.double() * y.double()).sum((0, 1)) for x, y in parts)
    return torch.as_tensor(total).to(a)
