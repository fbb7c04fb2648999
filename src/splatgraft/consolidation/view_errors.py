"""Per-view errors of a harmoniser, a low-frequency tint and a small flow, and target images without them.

A harmoniser that works view by view shifts edges by a pixel and drifts in colour. Both errors are smooth over the
image, so that a coarse grid per view describes them. The scene stays sharp if they are removed from the view's image
before the colours are fitted. Each refinement takes one robust Gauss-Newton step in closed form.
"""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views, memory_bytes

# set by hand
_FLOW_CELL_PX, _TINT_CELL_PX = 32.0, 88.0  # distance between the knots of the flow and of the tint
_FLOW_SIGMA_PX = 0.5  # expected size of the flow: a ridge keeps it small where the image has no texture
_MAX_FLOW_PX = 4.0 * _FLOW_SIGMA_PX
_TINT_SIGMA = 0.1  # expected size of the logarithm of the gain
_RESIDUAL_SIGMA = 0.05  # expected size of the remaining residual; larger ones count less (Geman-McClure weights)
_CORRELATED_PX = 16.0  # neighbouring pixels with correlated residuals, which count as one observation


@dataclass(frozen=True)
class ViewError:
    """One view's error on coarse grids: image(p + flow) * exp(log_gain) is the corrected image."""

    flow: Float[Tensor, "a b 2"]
    """Shift in x and y at each knot, pixels."""
    log_gain: Float[Tensor, "c d 3"]
    """Natural logarithm of the factor on each channel at each knot."""

    def correct(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """Remove this error from the image."""
        h, w = image.shape[:2]
        return _warp(image, _upsample(self.flow, h, w)) * _upsample(self.log_gain, h, w).exp()


def no_view_error(image: Float[Tensor, "h w 3"]) -> ViewError:
    """Make a zero error, on the grids for an image of this size."""
    (a, b), (c, d) = ([_knots(n, cell) for n in image.shape[:2]] for cell in (_FLOW_CELL_PX, _TINT_CELL_PX))
    return ViewError(flow=image.new_zeros(a, b, 2), log_gain=image.new_zeros(c, d, 3))


@torch.no_grad()
def refine(view_error: ViewError, image: Float[Tensor, "h w 3"], render: Float[Tensor, "h w 3"]) -> ViewError:
    """Take one Gauss-Newton step on the tint of the view's error, then one on its flow; images are sRGB."""
    h, w = image.shape[:2]
    warped = _warp(image, _upsample(view_error.flow, h, w))
    tinted = warped * _upsample(view_error.log_gain, h, w).exp()
    log_gain = _refine_tint(view_error.log_gain, tinted, render)
    tinted = warped * _upsample(log_gain, h, w).exp()
    return ViewError(_refine_flow(view_error.flow, tinted, render), log_gain)


class CorrectedTargets:
    """Targets of the views, each corrected by its `ViewError` (a few kB), which is refined as colours are fitted."""

    def __init__(self, views: Views, estimated: bool = True) -> None:
        """Start with zero errors; they stay zero unless `estimated`."""
        self.views, self._estimated = views, estimated
        self._of_view: list[ViewError | None] = [None] * len(views)
        self._kept: dict[int, Tensor] | None = None

    def target(self, index: int) -> Float[Tensor, "h w 3"]:
        """Return the view's image, corrected by the current estimate of its error."""
        if self._kept is not None and index in self._kept:
            return self._kept[index]
        image, view_error = self.views.target(index), self._of_view[index]
        corrected = image if view_error is None else view_error.correct(image)
        if self._kept is not None and self.views.take_bytes(memory_bytes(corrected)):
            self._kept[index] = corrected
        return corrected

    def keep(self) -> None:
        """Fix the errors, and keep corrected images in the unused part of the views' cache."""
        self._kept = {}

    def refine(self, index: int, render: Float[Tensor, "h w 3"]) -> None:
        """Refine the view's error against a render of the current scene."""
        assert self._kept is None
        if not self._estimated:
            return
        image = self.views.target(index)
        known = self._of_view[index] or no_view_error(image)
        self._of_view[index] = refine(known, image, render.detach())

    def center(self) -> None:
        """Subtract the mean gain of all views from their errors, because it belongs to the scene."""
        gains = [n.log_gain.mean((0, 1)) for n in self._of_view if n is not None]
        if gains:
            mean = torch.stack(gains).mean(0)
            self._of_view = [n and replace(n, log_gain=n.log_gain - mean) for n in self._of_view]


def _refine_tint(
    log_gain: Float[Tensor, "c d 3"],
    tinted: Float[Tensor, "h w 3"],
    render: Float[Tensor, "h w 3"],
) -> Float[Tensor, "c d 3"]:
    rows, columns = _grid_bases(log_gain, tinted)
    residual = render - tinted
    robust = _robust_weights(residual)
    channels = []
    for channel in range(3):
        slope, knots = tinted[..., channel], log_gain[..., channel]
        ridge = (_RESIDUAL_SIGMA / _TINT_SIGMA) ** 2 * _observations_per_knot(robust, slope.numel(), knots.numel())
        normal = _normal_matrix(robust * slope**2, rows, columns)
        normal += ridge * torch.eye(knots.numel(), device=knots.device)
        right = rows.T @ (robust * slope * residual[..., channel]) @ columns
        step = _solve(normal, right.flatten() - ridge * knots.flatten())
        channels.append(knots + step.reshape(knots.shape))
    return torch.stack(channels, -1)


def _refine_flow(
    flow: Float[Tensor, "a b 2"],
    tinted: Float[Tensor, "h w 3"],
    render: Float[Tensor, "h w 3"],
) -> Float[Tensor, "a b 2"]:
    rows, columns = _grid_bases(flow, tinted)
    # a slight blur widens the range of the linearisation to about 1.5 px and keeps noise out of the slopes
    smooth_image, smooth_render = _blur(tinted), _blur(render)
    residual = smooth_render - smooth_image
    robust = _robust_weights(residual)
    dx, dy = _slopes(0.5 * (smooth_image + smooth_render))
    xx, xy, yy = (_over_channels(a * b) * robust for a, b in ((dx, dx), (dx, dy), (dy, dy)))
    right = torch.stack([rows.T @ (robust * _over_channels(d * residual)) @ columns for d in (dx, dy)])
    first, cross, second = (_normal_matrix(weights, rows, columns) for weights in (xx, xy, yy))
    normal = torch.cat([torch.cat([first, cross], 1), torch.cat([cross, second], 1)])
    knots = flow.permute(2, 0, 1).flatten()
    ridge = (_RESIDUAL_SIGMA / _FLOW_SIGMA_PX) ** 2 * _observations_per_knot(robust, xx.numel(), len(knots) // 2)
    step = _solve(normal + ridge * torch.eye(len(knots), device=knots.device), right.flatten() - ridge * knots)
    moved = (knots + step).reshape(2, *flow.shape[:2]).permute(1, 2, 0)
    return moved.clamp(-_MAX_FLOW_PX, _MAX_FLOW_PX)


def _robust_weights(residual: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Compute Geman-McClure weights of the residual."""
    squares = _over_channels(residual**2) / (3 * _RESIDUAL_SIGMA**2)
    return 1 / (1 + squares) ** 2


def _observations_per_knot(robust: Float[Tensor, "h w"], pixels: int, knots: int) -> float:
    """Estimate the independent observations per knot: weighted pixels over the number of correlated ones."""
    return max(float(robust.sum()) / pixels, 1e-3) * pixels / knots / _CORRELATED_PX


def _normal_matrix(
    weights: Float[Tensor, "h w"], rows: Float[Tensor, "h a"], columns: Float[Tensor, "w b"]
) -> Float[Tensor, "ab ab"]:
    """Compute sum_p weights_p phi_p phi_p^T for phi = rows x columns, by the separability of the grid."""
    a, b = rows.shape[1], columns.shape[1]
    across = weights @ (columns[:, :, None] * columns[:, None, :]).reshape(-1, b * b)
    down = (rows[:, :, None] * rows[:, None, :]).reshape(-1, a * a).T @ across
    return down.reshape(a, a, b, b).permute(0, 2, 1, 3).reshape(a * b, a * b)


def _solve(normal: Float[Tensor, "k k"], right: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
    """Solve symmetric, positive definite equations."""
    return torch.cholesky_solve(right[:, None], torch.linalg.cholesky(normal))[:, 0]


def _knots(length: int, cell_px: float) -> int:
    return max(2, round(length / cell_px) + 1)


def _grid_bases(
    grid: Float[Tensor, "a b c"], image: Float[Tensor, "h w 3"]
) -> tuple[Float[Tensor, "h a"], Float[Tensor, "w b"]]:
    rows, columns = (_linear_weights(image.shape[axis], grid.shape[axis], like=grid) for axis in (0, 1))
    return rows, columns


def _linear_weights(length: int, knots: int, *, like: Tensor) -> Float[Tensor, "length knots"]:
    """Compute linear weights of evenly spaced knots, the outer ones at the image's ends, at pixel centres."""
    position = (torch.arange(length, dtype=like.dtype, device=like.device) + 0.5) / length * (knots - 1)
    return (1 - (position[:, None] - torch.arange(knots, device=like.device)).abs()).clamp_min(0)


def _upsample(grid: Float[Tensor, "a b c"], height: int, width: int) -> Float[Tensor, "h w c"]:
    rows, columns = _linear_weights(height, grid.shape[0], like=grid), _linear_weights(width, grid.shape[1], like=grid)
    return torch.stack([rows @ channel @ columns.T for channel in grid.unbind(-1)], -1)


def _warp(image: Float[Tensor, "h w 3"], flow: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w 3"]:
    """Sample the image at p + flow, bicubic so that sub-pixel shifts do not blur; the border repeats."""
    if not flow.any():
        return image
    h, w = image.shape[:2]
    x = torch.arange(w, device=flow.device) + 0.5 + flow[..., 0]
    y = torch.arange(h, device=flow.device)[:, None] + 0.5 + flow[..., 1]
    grid = torch.stack([2 * x / w - 1, 2 * y / h - 1], -1)[None]
    planes = image.permute(2, 0, 1)[None]
    sampled = F.grid_sample(planes, grid, mode="bicubic", padding_mode="border", align_corners=False)
    return sampled[0].permute(1, 2, 0)


def _blur(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Blur by binomial taps 1 4 6 4 1 along both axes; the border repeats."""
    for axis in (0, 1):
        length = image.shape[axis]
        first, last = image.narrow(axis, 0, 1), image.narrow(axis, length - 1, 1)
        padded = torch.cat([first, first, image, last, last], axis)
        a, b, c, d, e = (padded.narrow(axis, shift, length) for shift in range(5))
        image = (a + e).add_(b + d, alpha=4.0).add_(c, alpha=6.0).mul_(1 / 16)
    return image


def _over_channels(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    # torch's sum over a last axis of three numbers is several times slower
    red, green, blue = image.unbind(-1)
    return red + green + blue


def _slopes(image: Float[Tensor, "h w 3"]) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    dy, dx = torch.gradient(image, dim=(0, 1))
    return dx, dy
