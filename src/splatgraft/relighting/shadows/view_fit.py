"""Fit of shadows to views: ratios of receivers whose blend matches the surface's ratio in each pixel.

A surface is drawn by Gaussians in a layer, blended in the order of their centres. From a low camera, a Gaussian that
lies a little too high hides the surface well behind it. A shadow evaluated at the centres is therefore displaced and
blurred. Rendering is linear in the Gaussians' values, so simultaneous iterative reconstruction (SIRT, Gilbert 1972)
finds the value of each receiver, and its slope over view directions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shadows.scene_ratio import DARKEST, SceneRatio
from splatgraft.relighting.shadows.surface_views import GAMMA, SurfaceView, blended_values
from splatgraft.rendering import ViewOperator

# the solver; set by hand
_ROUNDS = 5  # iterations
_NARROWEST_PX = 0.5
"""Smallest standard deviation of a fitted Gaussian, pixels: a reduced view draws finer ones too wide.

Measured on planes: at 0.3 the fit makes shadows worse, at 0.6 better."""
_RECEIVING = 0.5  # smallest share of receivers in a pixel that is fitted
_MAX_SLOPE = 0.9  # largest share of a value that a view direction takes away
_MIN_WEIGHT = 0.05  # pixels; receivers with less weight in all views together are not fitted


@dataclass(frozen=True)
class _FittedView:
    """One view of m receivers and the k other Gaussians in front of a camera."""

    which: Int[Tensor, "m"]
    """Positions of the m among all receivers."""
    others: int
    """Number k of the other Gaussians, whose value is 1."""
    weights: ViewOperator
    """Map from values of these Gaussians to pixels, receivers first."""
    target: Float[Tensor, "h w"]
    """Wanted blend of the values; their first blend in pixels away from the shadow."""
    directions: Float[Tensor, "m 3"]
    """Unit, from the camera to each receiver."""
    wide: Bool[Tensor, "m"]
    """Whether a receiver is wide enough to be drawn at its own width."""


def fit_to_views(ratio: SceneRatio, gaussians: Gaussians, views: Sequence[SurfaceView]) -> SceneRatio:
    """Fit the ratios of receivers to views of their surface.

    Args:
        ratio: Ratios at the centres of the m receivers.
        gaussians: The scene, receivers first.
        views: Views of the surface; if there are none, the ratios stay.

    Returns:
        The fitted ratios; receivers that no view shows keep theirs.
    """
    if not views:
        return ratio
    values = blended_values(ratio)
    value, slope, known = _solved(values, [_fitted(view, gaussians) for view in views])
    wanted, before = value**GAMMA, ratio.shadow.mean(1).clamp_min(1e-6)
    factor = ((wanted - ratio.bounce.mean(1)) / before).clamp_min(0)
    shadow = (ratio.shadow * factor[:, None]).clamp(DARKEST, 1)
    slope = GAMMA * (value ** (GAMMA - 1))[:, None] * slope
    return SceneRatio(
        shadow=torch.where(known[:, None], shadow, ratio.shadow),
        bounce=ratio.bounce,
        slope=torch.where(known[:, None], slope, ratio.slope),
    )


def _fitted(view: SurfaceView, gaussians: Gaussians) -> _FittedView:
    """Compute the wanted blend of a view's pixels."""
    count, target = len(view.receivers), view.value.clone()
    pixels = view.mass[view.shown] > _RECEIVING
    wanted = view.shown.clone()
    wanted[view.shown] = pixels
    target[wanted] = view.weights.alpha[wanted] * view.ratio[pixels] ** (1 / GAMMA)
    directions = F.normalize(gaussians.means[view.receivers] - view.camera.centers[0], dim=1)
    is_wide = view.drawn_px[:count] > _NARROWEST_PX
    return _FittedView(view.receivers, len(view.which) - count, view.weights, target, directions, is_wide)


def _solved(
    values: Float[Tensor, "r"], views: Sequence[_FittedView]
) -> tuple[Float[Tensor, "r"], Float[Tensor, "r 3"], Bool[Tensor, "r"]]:
    """Solve for values and slopes of the receivers, and return which of them were fitted."""
    slope, weight = torch.zeros(len(values), 3), torch.zeros(len(values))
    wide = torch.zeros(len(values), dtype=torch.bool)
    for view in views:
        seen = view.weights.blend_transpose(torch.ones_like(view.target)[..., None])[: len(view.which), 0]
        weight[view.which] += seen
        wide[view.which] |= view.wide
    step = torch.where(wide & (weight > _MIN_WEIGHT), 1 / weight.clamp_min(_MIN_WEIGHT), 0)
    least = DARKEST ** (1 / GAMMA)
    for _ in range(_ROUNDS):
        change, turn = torch.zeros_like(values), torch.zeros_like(slope)
        for view in views:
            shown = values[view.which] + (slope[view.which] * view.directions).sum(1)
            seen = torch.cat([shown, torch.ones(view.others)])
            back = view.weights.transpose_residual(seen, view.target)[: len(view.which)]
            change[view.which] += back
            turn[view.which] += back[:, None] * view.directions
        values = (values + step * change).clamp(least, 1)
        slope = slope + step[:, None] * turn
        most = torch.minimum(_MAX_SLOPE * values, 1 - values)[:, None]
        slope = slope * (most / slope.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1)
    return values, slope, step > 0
