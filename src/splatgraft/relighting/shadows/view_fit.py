"""Shadows fitted in the target's own views: ratios of receivers that draw the ratio of the surface seen in each pixel.

A surface is drawn by Gaussians in a layer, blended in the order of their centres. From low above it, one that is a
little too high hides the surface well behind it, so a shadow that is evaluated at the centres is displaced from every
side, and blurred. Rendering is linear in the Gaussians' values: simultaneous iterative reconstruction (SIRT, Gilbert
1972) finds a value and a slope over view directions for each Gaussian whose blend is nearest to the true ratio.
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
"""Widest standard deviation in pixels below which a Gaussian keeps what it has: a reduced view draws it wider than
it is, and so in the wrong place. Measured on planes: at 0.3 the fit makes shadows worse, at 0.6 better."""
_RECEIVING = 0.5  # share of a pixel that receivers must make up
_MAX_SLOPE = 0.9  # most share of a value that a view direction takes away
_MIN_WEIGHT = 0.05  # pixels; receivers with less weight in all views together keep what they have


@dataclass(frozen=True)
class _FittedView:
    """One view of the Gaussians in front of a camera, of which the first m are receivers."""

    which: Int[Tensor, "m"]
    """Positions of these among all receivers."""
    fixed: Float[Tensor, "k"]
    """Values of the Gaussians after the first m."""
    weights: ViewOperator
    """From values of all these Gaussians to pixels."""
    target: Float[Tensor, "h w"]
    """What the values must blend to: where no shadow is near, what they blend to at first."""
    directions: Float[Tensor, "m 3"]
    """Unit, from the camera to each receiver."""
    wide: Bool[Tensor, "m"]
    """Which receivers the view draws as wide as they are."""


def fit_to_views(
    ratio: SceneRatio, gaussians: Gaussians, views: Sequence[SurfaceView], catchers: Gaussians
) -> SceneRatio:
    """Fit the ratios of receivers to what some views show of them.

    Args:
        ratio: Ratios of the m receivers so far, at their centres; those that no view shows keep them.
        gaussians: The scene, receivers first.
        views: Of the surface that they form; none to change nothing.
        catchers: Black Gaussians that shade what lies behind the receivers.
    """
    if not views:
        return ratio
    values = blended_values(ratio)
    value, slope, known = _solved(values, [_fitted(view, values, gaussians, catchers) for view in views])
    wanted, before = value**GAMMA, ratio.shadow.mean(1).clamp_min(1e-6)
    factor = ((wanted - ratio.bounce.mean(1)) / before).clamp_min(0)
    shadow = (ratio.shadow * factor[:, None]).clamp(DARKEST, 1)
    slope = GAMMA * (value ** (GAMMA - 1))[:, None] * slope
    return SceneRatio(
        shadow=torch.where(known[:, None], shadow, ratio.shadow),
        bounce=ratio.bounce,
        slope=torch.where(known[:, None], slope, ratio.slope),
    )


def _fitted(view: SurfaceView, values: Float[Tensor, "m"], gaussians: Gaussians, catchers: Gaussians) -> _FittedView:
    """A view with what its pixels must show past the catchers."""
    count = len(view.receivers)
    fixed, weights, target = torch.ones(len(view.which) - count), view.weights, view.value.clone()
    if catchers.count:
        weights, fixed, target = view.with_catchers(gaussians, catchers, values)
    pixels = view.mass[view.shown] > _RECEIVING
    wanted = view.shown.clone()
    wanted[view.shown] = pixels
    target[wanted] = weights.alpha[wanted] * view.ratio[pixels] ** (1 / GAMMA)
    directions = F.normalize(gaussians.means[view.receivers] - view.camera.centers[0], dim=1)
    return _FittedView(view.receivers, fixed, weights, target, directions, view.drawn_px[:count] > _NARROWEST_PX)


def _solved(
    values: Float[Tensor, "r"], views: Sequence[_FittedView]
) -> tuple[Float[Tensor, "r"], Float[Tensor, "r 3"], Bool[Tensor, "r"]]:
    """Values and slopes of the receivers, and which of these were fitted."""
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
            seen = torch.cat([shown, view.fixed])
            back = view.weights.transpose_residual(seen, view.target)[: len(view.which)]
            change[view.which] += back
            turn[view.which] += back[:, None] * view.directions
        values = (values + step * change).clamp(least, 1)
        slope = slope + step[:, None] * turn
        most = torch.minimum(_MAX_SLOPE * values, 1 - values)[:, None]
        slope = slope * (most / slope.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1)
    return values, slope, step > 0
