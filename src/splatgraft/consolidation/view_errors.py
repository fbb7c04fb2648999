"""What one view gets wrong by itself: a low-frequency tint and a small flow, solved against a render and thrown away.

A harmoniser that works view by view shifts edges by a pixel and drifts in colour. Both are smooth over the image, so a
coarse grid per view describes them; taking them off the view's image before the colours are fitted keeps the scene
sharp. Closed form: one robust Gauss-Newton step per call. Knows nothing about Gaussians.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class NuisanceOptions:
    """How coarse and how free the per-view corrections are."""

    flow_cell_px: float = 32.0
    """Distance between the knots of the flow, pixels."""
    tint_cell_px: float = 88.0
    """Distance between the knots of the tint, pixels."""
    flow_sigma_px: float = 0.5
    """Expected size of the flow, pixels: the ridge that keeps it small where the image has no texture."""
    tint_sigma: float = 0.1
    """Expected size of the logarithm of the gain."""
    residual_sigma: float = 0.05
    """Expected size of what neither explains; larger residuals count less (Geman-McClure weights)."""


@dataclass(frozen=True)
class Nuisance:
    """One view's own error on coarse grids: image(p + flow) * exp(log_gain) is what the scene should look like."""

    flow: Float[Tensor, "a b 2"]
    """Where the image holds what belongs at a knot: shift in x and y, pixels."""
    log_gain: Float[Tensor, "c d 3"]
    """Natural logarithm of the factor on each channel."""

    def correct(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """The image without this error."""
        h, w = image.shape[:2]
        return _warp(image, _spread(self.flow, h, w)) * _spread(self.log_gain, h, w).exp()


def no_nuisance(image: Float[Tensor, "h w 3"], options: NuisanceOptions) -> Nuisance:
    """No error at all, on the grids of an image of that size."""
    (a, b), (c, d) = (
        [_knots(n, cell) for n in image.shape[:2]] for cell in (options.flow_cell_px, options.tint_cell_px)
    )
    return Nuisance(flow=image.new_zeros(a, b, 2), log_gain=image.new_zeros(c, d, 3))


@torch.no_grad()
def refine(
    nuisance: Nuisance,
    image: Float[Tensor, "h w 3"],
    render: Float[Tensor, "h w 3"],
    weight: Float[Tensor, "h w"] | None,
    options: NuisanceOptions,
) -> Nuisance:
    """One Gauss-Newton step of tint, then flow, towards the least robust error between corrected image and render."""
    h, w = image.shape[:2]
    confidence = image.new_ones(h, w) if weight is None else weight
    warped = _warp(image, _spread(nuisance.flow, h, w))
    tinted = warped * _spread(nuisance.log_gain, h, w).exp()
    log_gain = _refine_tint(nuisance.log_gain, tinted, render, confidence, options)
    tinted = warped * _spread(log_gain, h, w).exp()
    return Nuisance(
        flow=_refine_flow(nuisance.flow, tinted, render, confidence, options),
        log_gain=log_gain,
    )


def _refine_tint(
    log_gain: Float[Tensor, "c d 3"],
    tinted: Float[Tensor, "h w 3"],
    render: Float[Tensor, "h w 3"],
    confidence: Float[Tensor, "h w"],
    options: NuisanceOptions,
) -> Float[Tensor, "c d 3"]:
    rows, columns = _grid_bases(log_gain, tinted)
    residual = render - tinted
    trust = _trust(residual, confidence, options)
    channels = []
    for channel in range(3):
        slope, knots = tinted[..., channel], log_gain[..., channel]
        ridge = (options.residual_sigma / options.tint_sigma) ** 2 * _support(trust, slope.numel(), knots.numel())
        normal = _normal_matrix(trust * slope**2, rows, columns) + ridge * torch.eye(knots.numel(), device=knots.device)
        right = rows.T @ (trust * slope * residual[..., channel]) @ columns
        step = torch.linalg.solve(normal, right.flatten() - ridge * knots.flatten())
        channels.append(knots + step.reshape(knots.shape))
    return torch.stack(channels, -1)


def _refine_flow(
    flow: Float[Tensor, "a b 2"],
    tinted: Float[Tensor, "h w 3"],
    render: Float[Tensor, "h w 3"],
    confidence: Float[Tensor, "h w"],
    options: NuisanceOptions,
) -> Float[Tensor, "a b 2"]:
    rows, columns = _grid_bases(flow, tinted)
    # a slight blur widens the basin of the linearisation to about 1.5 px and keeps noise out of the slopes
    smooth_image, smooth_render = _blur(tinted), _blur(render)
    residual = smooth_render - smooth_image
    trust = _trust(residual, confidence, options)
    dx, dy = _slopes(0.5 * (smooth_image + smooth_render))
    xx, xy, yy = ((a * b).sum(-1) * trust for a, b in ((dx, dx), (dx, dy), (dy, dy)))
    right = torch.stack([rows.T @ (trust * (d * residual).sum(-1)) @ columns for d in (dx, dy)])
    cross = _normal_matrix(xy, rows, columns)
    normal = torch.cat(
        [
            torch.cat([_normal_matrix(xx, rows, columns), cross], 1),
            torch.cat([cross, _normal_matrix(yy, rows, columns)], 1),
        ]
    )
    knots = flow.permute(2, 0, 1).flatten()
    ridge = (options.residual_sigma / options.flow_sigma_px) ** 2 * _support(trust, xx.numel(), len(knots) // 2)
    step = torch.linalg.solve(
        normal + ridge * torch.eye(len(knots), device=knots.device), right.flatten() - ridge * knots
    )
    moved = (knots + step).reshape(2, *flow.shape[:2]).permute(1, 2, 0)
    return moved.clamp(-4 * options.flow_sigma_px, 4 * options.flow_sigma_px)


def _trust(
    residual: Float[Tensor, "h w 3"], confidence: Float[Tensor, "h w"], options: NuisanceOptions
) -> Float[Tensor, "h w"]:
    squares = (residual**2).mean(-1) / options.residual_sigma**2
    return confidence / (1 + squares) ** 2


def _support(trust: Float[Tensor, "h w"], pixels: int, knots: int) -> float:
    """Trusted pixels per knot, at least one: neighbouring residuals are correlated, so a knot counts as one sample."""
    return max(float(trust.sum()) / pixels, 1e-3) * pixels / knots / _CORRELATED_PX


# pixels over which a residual (a misplaced edge, a wrong shade) stays alike, so that they count as one observation
_CORRELATED_PX = 16.0


def _normal_matrix(
    weights: Float[Tensor, "h w"], rows: Float[Tensor, "h a"], columns: Float[Tensor, "w b"]
) -> Float[Tensor, "ab ab"]:
    """sum_p weights_p phi_p phi_p^T for phi = rows x columns, by the separability of the grid."""
    a, b = rows.shape[1], columns.shape[1]
    across = weights @ (columns[:, :, None] * columns[:, None, :]).reshape(-1, b * b)
    down = (rows[:, :, None] * rows[:, None, :]).reshape(-1, a * a).T @ across
    return down.reshape(a, a, b, b).permute(0, 2, 1, 3).reshape(a * b, a * b)


def _knots(length: int, cell_px: float) -> int:
    return max(2, round(length / cell_px) + 1)


def _grid_bases(
    grid: Float[Tensor, "a b c"], image: Float[Tensor, "h w 3"]
) -> tuple[Float[Tensor, "h a"], Float[Tensor, "w b"]]:
    return _tents(image.shape[0], grid.shape[0], like=grid), _tents(image.shape[1], grid.shape[1], like=grid)


def _tents(length: int, knots: int, *, like: Tensor) -> Float[Tensor, "length knots"]:
    """Linear interpolation from knots at the two ends and evenly between to pixel centres."""
    position = (torch.arange(length, dtype=like.dtype, device=like.device) + 0.5) / length * (knots - 1)
    return (1 - (position[:, None] - torch.arange(knots, device=like.device)).abs()).clamp_min(0)


def _spread(grid: Float[Tensor, "a b c"], height: int, width: int) -> Float[Tensor, "h w c"]:
    rows, columns = _tents(height, grid.shape[0], like=grid), _tents(width, grid.shape[1], like=grid)
    return torch.stack([rows @ channel @ columns.T for channel in grid.unbind(-1)], -1)


def _warp(image: Float[Tensor, "h w 3"], flow: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w 3"]:
    """The image at p + flow, bicubic so that sub-pixel shifts do not blur; the border repeats."""
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
    taps = image.new_tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
    planes = F.pad(image.permute(2, 0, 1)[:, None], (2, 2, 2, 2), mode="replicate")
    planes = F.conv2d(F.conv2d(planes, taps.reshape(1, 1, 1, 5)), taps.reshape(1, 1, 5, 1))
    return planes[:, 0].permute(1, 2, 0)


def _slopes(image: Float[Tensor, "h w 3"]) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    dy, dx = torch.gradient(image, dim=(0, 1))
    return dx, dy
